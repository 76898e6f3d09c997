"""What the experiments of classical design reach, and what an independent tracer says of it."""

import pytest
import torch

from dolens import load_lens
from dolens.optimize import MeritSettings
from dolens.plotting.transmission import mean_reflectance
from tests.experiments.tiny_experiment import ONE_EPOCH, QUIET, UNPICTURED
from tests.optics import exact

SHOWN = [UNPICTURED, QUIET]


def rms_um_traced_again(lens, spots, spot, every):
    """RMS radius of one ray in `every` of a spot, by the 80-digit tracer and by dolens."""
    rays = torch.nonzero(spots.spot == spot).flatten()[::every]
    values = exact.values_of(lens)
    points = []
    for ray in rays.tolist():
        start = spots.rays.position[ray].tolist(), spots.rays.direction[ray].tolist()
        status, _, point, *_ = exact.trace(lens, values, *start, float(spots.rays.wavelength[ray]))
        assert status == exact.OK
        points.append([float(point[0]), float(point[1])])
    own = lens.trace(spots.rays).position[rays, :2].detach()
    both = (torch.tensor(points, dtype=torch.float64), own)
    return [1e3 * float((p - p.mean(0)).square().sum(1).mean().sqrt()) for p in both]


def test_the_nikon_lens(trained):
    """Table II with its own variables: 28.06 µm to 0.18 µm, with the focal length and the edges
    held, and no more light lost than is allowed.
    """
    found = trained("experiment=nikon", "trainer.max_epochs=2", *SHOWN)
    metrics = found.metrics
    assert metrics["rms_spot_um/initial"] == pytest.approx(28.06, abs=0.01)
    assert metrics["rms_spot_um/published"] == pytest.approx(0.777, abs=0.001)
    assert found.objective < 0.18
    assert metrics["light/final"] > 0.9 * metrics["light/initial"]
    assert metrics["cost/rays"] < 0.2 * metrics["cost/rays_launched"]
    assert metrics["error/sampling_um"] < 0.02
    lens = found.lens()
    assert lens.first_order().efl.item() == pytest.approx(1.5736, abs=1e-4)
    edges = [row for row in found.table("operands") if "edge" in row["operand"]]
    assert len(edges) > 15 and all(float(row["value"]) > 0.0 for row in edges)
    spots = MeritSettings(sampling="square_grid").rays(lens)
    for spot in (1, 10):
        again, own = rms_um_traced_again(lens, spots, spot, 20)
        assert own == pytest.approx(again, rel=1e-9)
        assert again < 0.4


def test_the_double_gauss_recovers_within_its_constraints(trained):
    """The solve holds the focal length, bounds and limits end up active, the light stays."""
    found = trained("experiment=double_gauss", *SHOWN)
    metrics, lens = found.metrics, found.lens()
    assert found.objective < 20.0 < 0.1 * metrics["rms_spot_um/initial"]
    assert lens.first_order().efl.item() == pytest.approx(99.56, abs=1e-9)
    bounds = {"1": (5, 10), "2": (0.2, 1), "5": (8, 14), "8": (8, 14), "10": (5, 8)}
    for gap, (low, high) in bounds.items():
        assert low - 1e-12 <= lens.thicknesses[gap].item() <= high + 1e-12, gap
    assert float(found.table("history")[-1]["train/active_bounds"]) >= 3
    operands = {row["operand"]: row for row in found.table("operands")}
    assert abs(float(operands["bfd"]["value"]) - 64.0) < 0.1
    assert abs(float(operands["distortion/0,22"]["value"])) <= 3.05
    # Derivatives by each variable in its own unit: of the total track by a thickness, 1, and what
    # the focus does.
    assert "thicknesses.8" in operands["bfd"]
    assert metrics["light/final"] > 0.98 * metrics["light/initial"]


FREEFORM = [
    "experiment=freeform",
    *SHOWN,
    "merit.sampling_options={rings: 6, arms: 12}",
    "test=false",
    "objective=train/merit",
]


def test_a_freeform_corrector_by_least_squares_and_by_adam(trained):
    """256 coefficients; the rule of the configuration picks the optimizer by their number."""
    few = trained(*FREEFORM, "data.iterations=8", folder="few")
    many = trained(*FREEFORM, "optimizer.max_variables=100", "data.iterations=30")
    assert "train/damping" in few.table("history")[0]
    start = many.table("history")[0]
    assert "train/learning_rate" in start
    assert few.objective < 600.0
    assert few.objective < many.objective < float(start["train/merit"]) < 1950.0


def test_least_squares_on_a_modulation(trained):
    """From the triplet's 0.667 to below 0.56 in 12 iterations of a loss that is no square sum."""
    modulation = ["experiment=cooke_modulation", *SHOWN, "test=false", "objective=train/merit"]
    found = trained(*modulation, "data.iterations=12", ONE_EPOCH)
    assert found.objective < 0.56 < float(found.table("history")[0]["train/merit"]) < 0.667


def test_white_light_keeps_the_focal_length(trained):
    found = trained("experiment=asphere_polychromatic", *SHOWN)
    assert found.objective < found.metrics["rms_spot_um/published"]
    row = found.table("operands")[0]
    assert row["operand"] == "efl" and float(row["value"]) == pytest.approx(39.81, abs=1e-3)


def test_four_layers_reflect_less_than_the_best_textbook_coating(trained):
    """Means over a finer grid than the design saw."""
    found = trained("experiment=coating", "trainer.max_epochs=1", *SHOWN)
    waves = torch.linspace(400.0, 700.0, 61, dtype=torch.float64)
    means = {
        name: sum(float(mean_reflectance(lens, waves, angle).mean()) for angle in (0, 10, 20, 30))
        / 4
        for name, lens in (("own", found.lens()), ("textbook", load_lens("textbook_window")))
    }
    assert means["own"] < 0.9 * means["textbook"]
    metrics = found.metrics
    assert metrics["transmission/initial"] < metrics["transmission/published"]
    assert metrics["transmission/published"] < metrics["transmission/final"] < 1.0
