import pytest

from scripts.training_time import Training, table


def training(model, step_seconds, plan_seconds, curve):
    return Training(model, plan_seconds, step_seconds, 0.1, curve, 24.0, 23.9)


FAST = training("functions", 0.5, 20.0, {10: 20.0, 20: 24.0, 40: 25.0})


def test_a_psnr_is_reached_between_two_validations():
    # Half-way from 20 dB at step 10 to 24 dB at step 20.
    assert FAST.first(22.0) == 15
    assert FAST.first(19.0) == 10
    assert FAST.first(25.1) is None


def test_seconds_hold_steps_and_their_share_of_plans():
    # 20 s of plans over 40 steps.
    assert FAST.seconds(20) == pytest.approx(20 * 0.5 + 10.0)


def test_the_table_asks_for_what_every_model_reaches():
    slow = training("rays", 2.0, 0.0, {20: 21.0, 40: 24.05})
    header, _, first, second = table([FAST, slow], None)
    assert "to 24.00 dB" in header
    assert "| 20 | 20 |" in first
    # 39.67 steps of two seconds.
    assert "| 80 | 40 |" in second
    # Where one never gets there it says so.
    assert table([FAST, slow], 25.0)[-1].count("–") == 2
