"""A camera's lens moved by least squares, in turns with the network."""

import json
import math

import pytest
import torch

from dolens.errors import InputError
from experiments.lens_least_squares import CameraOptimizer, LensLeastSquares
from experiments.training import run
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

DLS = ["optimizer.lens=dls", "optimizer.least_squares.every=2"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"every": 0}, "least_squares.every: 0"),
        ({"reach": -1.0}, "least_squares.reach: -1.0"),
        ({"reach": 2.0, "most": 1.0}, "least_squares.most: 1.0"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        LensLeastSquares(**settings)


def test_an_unknown_way_is_an_error():
    with pytest.raises(InputError, match="'newton' is unknown; allowed: adam, dls"):
        CameraOptimizer(torch.optim.Adam, "newton")


def test_the_plate_moves_in_turns_and_within_its_bounds(composed, tmp_path):
    """Metrics say how many steps were kept; without the network's own steps nothing moves it."""
    run(
        composed(
            "experiment=wavefront_coding",
            *TINY,
            *TINY_NETWORK,
            *DLS,
            "data.steps_per_epoch=6",
            "trainer.max_epochs=1",
        )
    )
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["lens_steps/kept"] + metrics["lens_steps/refused"] == 3.0
    moved = metrics["variables/surfaces.5.x3"] != pytest.approx(1.5e-5, rel=1e-6)
    assert moved == (metrics["lens_steps/kept"] > 0)
    for name in ("x3", "x2y", "xy2", "y3"):
        assert abs(metrics[f"variables/surfaces.5.{name}"]) <= 4.0e-5 * (1.0 + 1e-6)


def test_a_doublet_holds_its_focal_length(composed, tmp_path):
    """The solve holds it through the steps of least squares too."""
    run(
        composed(
            "experiment=large_fov_doublet",
            "renderer.sensor.height=32",
            "renderer.sensor.width=32",
            "renderer.fields=[1,1]",
            "renderer.size=15",
            "evaluation_renderer.pupil_samples=2",
            "data.margin=12",
            "data.steps_per_epoch=4",
            "data.evaluation_crops_per_photograph=1",
            "trainer.max_epochs=1",
            "+trainer.limit_val_batches=1",
            "+trainer.limit_test_batches=1",
            "+trainer.enable_progress_bar=false",
            "network.width_multiplier=0.25",
            "network.weights=none",
            "loss.perceptual=none",
            *DLS,
        )
    )
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["lens_steps/kept"] + metrics["lens_steps/refused"] == 2.0
    assert math.isfinite(metrics["test/psnr_db/field"])
