"""Coverage of pose bounds over many measurements, with and without what the model has not."""

import pytest

from tests.experiments.tiny_experiment import QUIET, UNPICTURED

# Workers could take every task of these runs.
pytestmark = pytest.mark.usefixtures("pickled_tasks")

SMALL = [
    "~fits.10",
    "~fits.25",
    "~fits.30",
    "sensor.height=32",
    "sensor.width=32",
    "sensor.pixel_pitch=0.2208",
    "photons=30000",
    "imager.rays=12000",
    "stages=[{optimizer: dls, iterations: 1, loss: noise_weighted, imager: {rim: 0.005}}]",
    QUIET,
]
COVERAGE = [
    "experiment=misalignment_coverage",
    *SMALL,
    "draws=12",
    "~cases.source",
    "~cases.background",
    "~cases.diffraction",
    "~cases.all",
    "cases.radius_and_index={radius: 0.006, index: 0.0}",
]


def test_bounds_hold_where_the_model_does_and_a_lens_with_errors_breaks_them(trained):
    found = trained(*COVERAGE)
    metrics = found.metrics
    rows = {(r["case"], r["fit"], r["variable"]): r for r in found.table("coverage")}
    assert len(rows) == 2 * 11
    # The mean of 12 χ² variables of 11 degrees of freedom: 1 ± √(2/12/11), four times.
    assert metrics["coverage/model/chi_squared"] == pytest.approx(1.0, abs=0.5)
    assert 0.5 < metrics["coverage/model/within_1"] < 0.85
    assert 0.85 < metrics["coverage/model/within_2"] <= 1.0
    assert metrics["coverage/model/unsettled"] == 0.0
    assert metrics["coverage/radius_and_index/chi_squared"] > 20.0
    assert (
        metrics["coverage/radius_and_index/within_2"] < metrics["coverage/model/within_2"]
        or metrics["coverage/radius_and_index/rms_over_bound"] > 2.0
    )
    for (case, fit, name), row in rows.items():
        ratio = float(row["rms_error"]) / float(row["bound"])
        assert ratio == pytest.approx(float(row["rms_over_bound"]), rel=1e-4)
        assert metrics[f"pose_rms_error/{case}/{fit}/{name}"] == pytest.approx(
            float(row["rms_error"]), rel=1e-4
        )
    draws = found.table("draws")
    assert len(draws) == 2 * 2 * 12
    shares = [float(row["probability"]) for row in draws if row["case"] == "model"]
    # Chances are even from 0 to 1 where the model holds: their mean is 1/2 ± √(1/12/24).
    assert sum(shares) / len(shares) == pytest.approx(0.5, abs=4.0 * 0.059)
    assert found.figures == {"errors_over_bounds"}


def test_a_fit_says_how_its_bound_covers_other_measurements(trained):
    """Columns of poses.csv; and what is fitted has the effects that are configured."""
    fit = "{variables: {sensor_distance: {initial: 119.4}}, truth: {sensor_distance: 119.45}}"
    near = [f"+fits.near={fit}", "~fits.0", "~fits.5"]
    common = ["experiment=misalignment", *SMALL, UNPICTURED, *near]
    ended = trained(*common, "monte_carlo=6", folder="plain")
    off = trained(*common, "monte_carlo=0", "unmodelled.radius=0.02").table("poses")
    plain, metrics = ended.table("poses"), ended.metrics
    for row in plain:
        assert float(row["measurements"]) == 6.0
        name = f"{row['fit']}/{row['variable']}"
        assert float(row["within_1"]) == pytest.approx(metrics[f"pose_within_1_bound/{name}"])
        assert float(row["within_2"]) == pytest.approx(metrics[f"pose_within_2_bounds/{name}"])
        assert float(row["within_95"]) == pytest.approx(metrics[f"pose_coverage/{name}"])
        assert float(row["within_1"]) <= float(row["within_95"]) <= float(row["within_2"])
    assert "measurements" not in off[0]
    assert float(off[0]["found"]) != float(plain[0]["found"])


BAD_SETTINGS = {
    "+cases.model.radii=0.1": "cases.model: unknown key 'radii'",
    "+cases.model.fits=['7']": "cases.model.fits: '7' is unknown (allowed: 0, 5",
    "+cases.model.fits=['5']": "cases.model.fits: '5' holds what '0' finds",
    "draws=1": "draws: 1; allowed: 2 or more",
    "unmodelled.radius=0.1": "unmodelled: effects are those of `cases` here",
    "~fits.0.truth.sensor_distance": "fits.0.truth: 'sensor_distance' is missing",
}


@pytest.mark.parametrize("override", BAD_SETTINGS)
def test_bad_settings_are_errors(refused, override):
    refused(BAD_SETTINGS[override], *COVERAGE, override)


def test_a_photograph_has_effects_of_its_own(refused):
    photograph = "measurement={path: spot.tif, pixel_pitch: 0.1}"
    of_its_own = ["experiment=misalignment", *SMALL, photograph, "unmodelled.diffraction=true"]
    refused("unmodelled: a photograph has effects of its own", *of_its_own)
