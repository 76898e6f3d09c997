"""Scores of crops become scores of photographs, with intervals, in a table that is read back."""

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import (
    TABLE,
    read_scores,
    scores_by_photograph,
    statistics_of,
)
from dolens.experiments.tables import write_table
from tests.experiments.tiny_experiment import CAMERA, ONE_EPOCH, UNPICTURED

VIEWS = ("near", "far")


def _scores():
    of_crops = torch.tensor([[1.0, 5.0], [3.0, 7.0], [10.0, 12.0]])
    return scores_by_photograph({"psnr_db": of_crops}, ["a", "a", "b"], VIEWS)


def test_each_photograph_counts_once_however_many_crops_it_has():
    scores = _scores()
    assert scores.photographs == ("a", "b") and scores.crops == (2, 1)
    assert torch.equal(scores.metrics["psnr_db"], torch.tensor([[2.0, 6.0], [10.0, 12.0]]))
    means = scores.metrics["psnr_db"].mean(dim=0)[None]
    found = {view: float(take(means)) for view, take in statistics_of(VIEWS).items()}
    assert found == {"": 7.5, "near": 6.0, "far": 9.0, "worst": 6.0}


def test_numbers_have_counts_and_intervals():
    numbers = _scores().numbers("test")
    assert numbers["test/photographs"] == 2 and numbers["test/crops"] == 3
    # Two photographs: the mean ± t of one degree of freedom standard deviations, s/√2.
    for view, mean, deviation in (("near", 6.0, 4.0), ("far", 9.0, 3.0), ("worst", 6.0, 4.0)):
        half = 12.706 * deviation
        low, high = (numbers[f"error/test/psnr_db/{view}/{end}"] for end in ("low", "high"))
        assert (low, high) == pytest.approx((mean - half, mean + half), rel=0.02)
    assert "error/test/psnr_db/low" in numbers


def test_the_table_is_read_back_as_it_was_written(tmp_path):
    assert read_scores(tmp_path) is None
    write_table(tmp_path / TABLE, _scores().rows())
    found = read_scores(tmp_path)
    assert (found.photographs, found.crops, found.views) == (("a", "b"), (2, 1), VIEWS)
    assert torch.equal(found.metrics["psnr_db"].float(), _scores().metrics["psnr_db"])


@pytest.mark.parametrize(
    "text",
    ["", "photograph,view\n", "photograph,crops,view,psnr_db\na,1,near,1\na,1,far,1\nb,1,near,1\n"],
)
def test_another_table_is_refused(tmp_path, text):
    (tmp_path / TABLE).write_text(text)
    with pytest.raises(InputError, match="not a table of scores"):
        read_scores(tmp_path)


def test_a_run_keeps_the_scores_of_its_photographs(trained):
    overrides = [o for o in CAMERA if "limit_test" not in o and "crops_per_photograph" not in o]
    found = trained(*overrides, ONE_EPOCH, "data.steps_per_epoch=1", UNPICTURED)
    scores, metrics = read_scores(found.folder), found.metrics
    assert scores.photographs == ("coffee.png", "chelsea.png", "coins.png")
    assert scores.crops == (4, 4, 4)
    assert metrics["test/photographs"] == 3 and metrics["test/crops"] == 12
    for name in ("psnr_db", "raw_ssim"):
        means = scores.metrics[name].mean(dim=0)
        for view, mean in zip(scores.views, means, strict=True):
            assert metrics[f"test/{name}/{view}"] == pytest.approx(float(mean), rel=1e-5)
        worst = metrics[f"test/{name}/worst"]
        assert worst == pytest.approx(float(means.min()), rel=1e-5)
        low, high = (metrics[f"error/test/{name}/worst/{end}"] for end in ("low", "high"))
        assert low < worst < high
