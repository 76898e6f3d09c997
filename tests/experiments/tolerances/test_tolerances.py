"""The tolerances of a lens as a run: tables, metrics, figures, and bad input."""

import math

import pytest
import torch

from dolens.analysis.pupil_quadrature import gaussian_quadrature
from tests.experiments.tiny_experiment import QUIET, UNPICTURED

# The whole path, with few rays; the fields are aimed one by one, which takes most of the time.
SMALL = [
    "experiment=cooke_sensitivity",
    "fields=[[0,0],[0,20],[-14,0]]",
    "wavelengths=[587.5618]",
    "lenses=200",
    "module.spots.pupil.rings=3",
    "module.spots.pupil.arms=6",
    QUIET,
]
AXIAL = [*SMALL, "fields=[[0,0]]", "lenses=20", UNPICTURED]
FIGURES = {
    "centroid_jacobian",
    "centroid_by_tolerance",
    "rms_jacobian",
    "rms_by_tolerance",
    "yield",
    "worst_offenders",
}


def test_a_run_leaves_tables_figures_and_metrics_that_agree(trained):
    found = trained(*SMALL, "lens.sensor.distance=42.3")
    metrics, objective = found.metrics, found.objective
    assert metrics["tolerance/rms_um/p90"] == objective
    assert found.info["status"] == "finished"
    assert found.figures == FIGURES
    assert list((found.folder / "tensorboard").glob("events.out.tfevents.*"))

    lenses = found.table("monte_carlo")
    radii = sorted(float(row["rms_um"]) for row in lenses)
    assert len(radii) == 200
    assert radii[179] == pytest.approx(objective, rel=1e-8)
    within = sum(radius <= 14.0 for radius in radii) / 200
    assert metrics["tolerance/yield_at_14um"] == pytest.approx(within)
    assert metrics["cost/rays"] == 200 * 3 * 3 * 6
    assert metrics["tolerance/failed_lenses"] == 0.0
    assert metrics["error/linear_p90"] < 0.01
    assert metrics["tolerance/rms_um/p90"] < metrics["tolerance/before_refocus/rms_um/p90"]

    offenders = found.table("worst_offenders")
    shares = [float(row["share_of_increase"]) for row in offenders]
    assert sum(shares) == pytest.approx(1.0) and shares == sorted(shares, reverse=True)
    assert len(offenders) == 24 and len(found.table("sensitivities")) == 24 * 3
    for row in offenders:
        name = f"sensitivity/rms_um/{row['parameter']}"
        assert metrics[name] == pytest.approx(float(row["rms_increase_um"]), rel=1e-6, abs=1e-9)
    check_first_lens(found.lens("initial"), lenses[0])


def check_first_lens(lens, row):
    """A row of the table, made by hand from its errors in the units of files, and traced."""
    fields, lines = [(0.0, 0.0), (0.0, 20.0), (-14.0, 0.0)], [587.5618]
    spots = gaussian_quadrature(lens, fields, lines, 3, 6, symmetry=False)
    for column, text in row.items():
        if "[" not in column:
            continue
        name, unit = column.rstrip("]").split(" [")
        with torch.no_grad():
            parameter = lens.variables([name])[name]
            error = float(text)
            if unit == "%":
                parameter.mul_(1.0 + error / 100.0)
            else:
                parameter.add_(math.radians(error) if unit == "deg" else error)

    def rms_um():
        points = lens.trace(spots.rays).position[:, :2].detach()
        weight, total = spots.weight[:, None], 0.0
        for spot in range(3):
            mine = spots.spot == spot
            centroid = (weight * points)[mine].sum(0)
            total += float((weight * (points - centroid).square())[mine].sum()) / 3
        return 1e3 * math.sqrt(total)

    assert rms_um() == pytest.approx(float(row["not_refocused_rms_um"]), rel=1e-6)
    with torch.no_grad():
        lens.sensor_distance += 1e-3 * float(row["refocus_um"])
    assert rms_um() == pytest.approx(float(row["rms_um"]), rel=1e-6)


def test_the_seed_decides_which_lenses_are_drawn(trained):
    first, again, other = (trained(*AXIAL, f"seed={seed}").objective for seed in (1, 1, 2))
    assert first == again != other


def test_tighter_tolerances_and_a_single_field_s_weight(trained):
    weighted = ["fields=[[0,0],[0,14]]", "field_weights=[1,0]", "tolerance_factor=1e-6"]
    metrics = trained(*AXIAL, *weighted, "lens_dtype=float32").metrics
    nominal = metrics["tolerance/rms_um/nominal"]
    assert metrics["tolerance/rms_um/p98"] == pytest.approx(nominal, rel=1e-4)
    # The only spot that counts is the worst one.
    assert metrics["tolerance/worst_rms_um/nominal"] == pytest.approx(nominal, rel=1e-6)


BAD_INPUT = {
    "+tolerances={elements.back.tilt_x: 0.1}": "no parameter 'elements.back.tilt_x'",
    # An error that rays have no derivative by.
    "+tolerances={media.1.index_offset: 0.0005}": (
        "tolerances.media.1.index_offset: allowed here: parameters of the lens"
    ),
    "+tolerances={thicknesses.2: -1}": "tolerances.thicknesses.2",
    "lenses=0": "lenses: 0; allowed: an integer of 1 or more",
    "fields=[[0]]": "fields: 2 numbers are needed, not 1",
    "fields=[]": "fields: none is given",
    "field_weights=[1]": "weights: 9 numbers are needed, not 1",
    "tolerance_factor=0": "tolerance_factor: must be a positive number",
    "wavelengths=[red]": "wavelengths: ['red']; allowed: a list, each a number",
    "yield_at_um=[wide]": "yield_at_um: ['wide']; allowed: a list, each a number",
    "test=false": "objective: 'tolerance/rms_um/p90' is no metric",
}


@pytest.mark.parametrize("override", BAD_INPUT)
def test_bad_input_gives_one_clear_line(refused, override):
    refused(BAD_INPUT[override], "experiment=cooke_sensitivity", override)
