"""What limits a pose fit, as a run."""

import math

import pytest

from tests.experiments.tiny_experiment import QUIET

# Workers could take every task of these runs.
pytestmark = pytest.mark.usefixtures("pickled_tasks")

TINY = [
    "experiment=pose_accuracy",
    "sensor.height=32",
    "sensor.width=32",
    "sensor.pixel_pitch=0.2208",
    "photons=100000",
    "imagers.narrow.rays=20000",
    "imagers.wide.rays=20000",
    "photon_levels=[20000,80000]",
    "measurements=8",
    "ray_counts=[500,20000]",
    "patterns=2",
    "reference_photons=5e6",
    "objective=pose_error/over_bound/photons_80000/noise_weighted",
    "basin.along={elements.lens.tilt_x: [0.0, 3.0], elements.lens.decenter_y: [0.5]}",
    "basin.centroid_weights=[1.0]",
    "basin.photons=1e5",
    "basin.imager.rays=4000",
    "basin.stages=[{optimizer: dls, iterations: 12}]",
    QUIET,
]


def test_errors_fall_with_light_and_rays_and_near_starts_converge(trained):
    ended = trained(*TINY)
    metrics, rows = ended.metrics, ended.table("accuracy")
    # Bounds of four times the light are half as large where shot noise rules.
    bounds = {
        (r["count"], r["variable"]): float(r["bound"]) for r in rows if r["part"] == "photons"
    }
    for name in {name for _, name in bounds}:
        ratio = bounds[("80000", name)] / bounds[("20000", name)]
        assert 0.4 < ratio < 0.52
    for level in (20000, 80000):
        # RMS of 8 estimates of 5 numbers: a standard error of 1/√80, times three.
        found = metrics[f"pose_error/over_bound/photons_{level}/noise_weighted"]
        assert found == pytest.approx(1.0, abs=0.35)
        assert found < metrics[f"pose_error/over_bound/photons_{level}/s21"]
    few, many = (
        metrics[f"pose_error/over_bound/rays/narrow_{count}/noise_weighted"]
        for count in (500, 20000)
    )
    assert many < 0.3 * few
    basin = ended.table("basin")
    assert [float(row["converged"]) for row in basin] == [1.0, 1.0]
    assert all(
        float(r["error_over_bound"]) < 0.1 * float(r["initial_error_over_bound"]) for r in basin
    )
    assert metrics["basin/converged/centroid_weight_1"] == 1.0
    assert ended.figures == {"photons", "rays", "basin"}


def test_a_start_without_light_is_a_lost_fit_and_not_the_end_of_the_run(trained):
    """Turned by 110° the lens shows its back, and no ray enters by its first surface."""
    far = "basin.along={elements.lens.tilt_x: [0.0, 120.0], elements.lens.decenter_y: [0.0]}"
    objective = "objective=basin/converged/centroid_weight_1"
    first, second = trained(*TINY, "parts=[basin]", far, objective).table("basin")
    assert float(first["converged"]) == 1.0 and float(second["converged"]) == 0.0
    assert float(second["iterations"]) == 0.0
    assert math.isfinite(float(second["error_over_bound"]))


BAD_INPUT = {
    "parts=[light]": "parts: 'light' is unknown (allowed: photons, rays, basin)",
    "+basin.along.focus=[0]": "focus; allowed: two of",
    "measurements=1": "measurements: 1; allowed: 2 or more",
    "imagers.narrow.rim=0": "imager.rim: 0; allowed",
    "lens_dtype=float32": "poses are fitted in float64",
}


@pytest.mark.parametrize("override", BAD_INPUT)
def test_bad_input_gives_one_clear_line(refused, override):
    refused(BAD_INPUT[override], *TINY, override)
