"""What a run says that its restoration gains, with intervals."""

import pytest
import torch

from dolens.experiments.camera.evaluation import behind_line, gain_line, gain_numbers
from dolens.experiments.camera.photograph_scores import PhotographScores
from tests.experiments.tiny_experiment import ONE_EPOCH, TINY, UNPICTURED


def scores(restored, raw, linear=None) -> PhotographScores:
    metrics = {"psnr_db": torch.tensor(restored), "raw_psnr_db": torch.tensor(raw)}
    if linear is not None:
        metrics["linear_psnr_db"] = torch.tensor(linear)
    names = tuple(f"photograph {n}" for n in range(len(restored)))
    return PhotographScores(names, (1,) * len(names), ("near", "far"), metrics)


def test_a_gain_that_every_photograph_has_is_certain():
    """Photographs differ by 10 dB, and the gain by nothing: intervals are paired."""
    raw = [[20.0, 21.0], [25.0, 26.0], [30.0, 31.0]]
    numbers = gain_numbers(scores([[a + 2.0, b + 3.0] for a, b in raw], raw), "test")
    assert numbers["test/gain_over_raw_db/near"] == pytest.approx(2.0)
    assert numbers["error/test/gain_over_raw_db/near/low"] == pytest.approx(2.0, abs=1e-6)
    assert numbers["error/test/gain_over_raw_db/near/high"] == pytest.approx(2.0, abs=1e-6)
    assert numbers["test/gain_over_raw_db"] == pytest.approx(2.5)
    assert not any("gain_over_filter" in name for name in numbers)


def test_at_the_worst_view_each_side_has_its_own():
    """Raw images are worst far away, restored ones nearby."""
    found = scores([[24.0, 26.0], [24.0, 26.0]], [[22.0, 20.0], [22.0, 20.0]])
    numbers = gain_numbers(found, "test")
    assert numbers["test/gain_over_raw_db/worst"] == pytest.approx(4.0)


def test_a_gain_that_photographs_disagree_about_has_a_wide_interval():
    found = scores([[24.0, 24.0], [20.0, 20.0]], [[20.0, 20.0], [22.0, 22.0]], [[23.0] * 2] * 2)
    numbers = gain_numbers(found, "test")
    assert numbers["error/test/gain_over_raw_db/worst/low"] < 0.0
    assert numbers["error/test/gain_over_raw_db/worst/high"] > 0.0
    assert "over the network's own linear filter; " in gain_line(found)


def test_a_run_says_its_gain(two_epochs):
    (said,) = [m for m in two_epochs.messages if m.startswith("Restored images")]
    metrics = two_epochs.metrics
    for name in ("gain_over_filter_db", "gain_over_raw_db"):
        gain = metrics[f"test/{name}/worst"]
        assert f"{gain:+.2f}" in said
        assert metrics[f"error/test/{name}/worst/low"] <= gain
    gain = metrics["test/psnr_db/worst"] - metrics["test/linear_psnr_db/worst"]
    assert metrics["test/gain_over_filter_db/worst"] == pytest.approx(gain, abs=1e-4)


def test_a_network_behind_an_untrained_restorer_is_told_so():
    behind = scores([[20.0, 21.0], [22.0, 23.0]], [[18.0] * 2] * 2)
    assert behind_line(behind) is None
    behind.metrics["tv_psnr_db"] = torch.tensor([[21.0, 22.0], [23.0, 24.0]])
    assert "-1.00 [-1.00, -1.00] dB over Wiener's filter and total variation" in behind_line(behind)
    behind.metrics["tv_psnr_db"] = torch.tensor([[19.0, 20.0], [21.0, 22.0]])
    assert behind_line(behind) is None


@pytest.mark.parametrize("network", ["unet", "feature_wiener", "wiener_tv"])
def test_every_test_has_the_scores_of_an_untrained_restorer(trained, two_epochs, network):
    untrained, found = network == "wiener_tv", two_epochs
    if network != "feature_wiener":
        settings = [f"network={network}", f"train={not untrained}", UNPICTURED, ONE_EPOCH]
        found = trained("experiment=wavefront_coding", *TINY, *settings)
    metrics = found.metrics
    for view in ("", "/worst"):
        found = metrics[f"test/tv_psnr_db{view}"]
        assert found > metrics[f"test/raw_psnr_db{view}"] - 1.0
        gain = metrics[f"test/psnr_db{view}"] - found
        assert metrics[f"test/gain_over_tv_db{view}"] == pytest.approx(gain, abs=1e-4)
        if untrained:
            assert gain == pytest.approx(0.0, abs=1e-4)


def test_what_nothing_trains_is_not_trained(refused):
    refused(
        "train: CameraModule trains nothing; set train=false",
        "experiment=wavefront_coding",
        *TINY,
        "network=wiener_tv",
    )
