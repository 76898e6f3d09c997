"""The co-designs on which optimizers of a lens are compared, and the table of their gains."""

import pytest

from scripts.co_design.cases import CASES, candidates
from scripts.co_design.results import gains, summary, table
from scripts.co_design.training import Trainings


@pytest.mark.parametrize("name", CASES)
def test_a_co_design_composes_and_its_lens_moves(name):
    """Its variables are those of the lens, and both optimizers take four settings."""
    case = CASES[name]
    found = candidates(case)
    assert {key: len(settings) for key, settings in found.items()} == {
        "adam": 4,
        "least squares": 4,
    }
    trainings = Trainings(["data=photos"], 1.0)
    overrides = [o for o in case.overrides if not o.startswith("~data")]
    module, _, score = trainings._made([*overrides, *found["least squares"][1]], 0)
    assert len(module.variables) >= 4
    assert module.lens_steps.apart
    assert score.startswith("psnr_db")


def runs(scores: dict[str, dict[str, list[float]]]) -> list[dict[str, object]]:
    return [
        {"case": case, "optimizer": o, "seed": n, "score": s, "steps": 10.0, "seconds": 12.0}
        for case, of_case in scores.items()
        for o, found in of_case.items()
        for n, s in enumerate(found)
    ]


def test_gains_are_paired_by_seed():
    found = runs(
        {
            "a": {"adam": [20.0, 22.0], "least squares": [21.0, 22.5]},
            "b": {"adam": [30.0, 30.0], "least squares": [29.9, 30.3]},
        }
    )
    by_case = gains(found)
    assert by_case["a"] == pytest.approx([1.0, 0.5])
    assert by_case["b"] == pytest.approx([-0.1, 0.3])
    assert summary(by_case).startswith("Least squares win 3 of 4, median +0.40 dB [")
    lines = table(found)
    assert "| a | 21.00 | 21.75 | +1.00, +0.50 | 10, 10 | 12.0, 12.0 |" in lines


def test_a_gain_that_all_have_is_certain():
    scores = {name: {"adam": [20.0], "least squares": [20.5]} for name in "abc"}
    assert "median +0.50 dB [+0.50, +0.50]" in summary(gains(runs(scores)))
