"""Which element is misaligned, as a run: table, metrics, figure, and bad input."""

import math

import pytest

from tests.experiments.tiny_experiment import QUIET

SMALL = [
    "experiment=triplet_alignment",
    "fields=[[0,0],[0,14],[-14,0],[14,-6]]",
    "misalignments=12",
    "module.spots.pupil.arms=16",
    "module.simulation_pupil.rings=5",
    "module.simulation_pupil.arms=20",
    "module.iterations=12",
    QUIET,
]
COLUMNS = ("tilt_x_deg", "tilt_y_deg", "decenter_x_um", "decenter_y_um")
SENSOR = ("sensor_x_um", "sensor_y_um", "focus_um")


def test_a_run_names_the_elements_and_its_table_agrees_with_its_metrics(trained):
    found = trained(*SMALL)
    metrics = found.metrics
    assert found.objective == metrics["alignment/named_right"] == 1.0
    assert metrics["alignment/converged"] == 1.0
    assert metrics["cost/batch_s"] > 0.0
    assert found.figures == {"alignment"}
    demo, *rows = found.table("alignment")
    assert len(rows) == 12 and {row["case"] for row in rows} == {str(k) for k in range(1, 13)}
    assert demo["true_element"] == demo["named_element"] == "middle"
    assert [float(demo[f"true_{c}"]) for c in COLUMNS] == pytest.approx([0.12, -0.05, 20.0, -30.0])
    errors = []
    for row in rows:
        assert row["true_element"] == row["named_element"]
        chi2 = {name: float(row[f"chi2_{name}"]) for name in ("front", "middle", "rear")}
        assert min(chi2, key=chi2.get) == row["named_element"]
        assert max(abs(float(row[f"true_{c}"])) for c in COLUMNS[:2]) <= 0.2
        assert max(abs(float(row[f"true_{c}"])) for c in COLUMNS[2:]) <= 50.0
        assert max(abs(float(row[f"true_{c}"])) for c in SENSOR) <= 20.0
        for c in (*COLUMNS, *SENSOR):
            difference = float(row[f"found_{c}"]) - float(row[f"true_{c}"])
            assert abs(difference) < 6.0 * float(row[f"bound_{c}"])
        errors.append(math.dist(*([float(row[f"{w}_{c}"]) for c in COLUMNS[:2]] for w in PAIR)))
    middle = sorted(errors)[5:7]
    assert metrics["pose_error/tilt_deg/median"] == pytest.approx(sum(middle) / 2, rel=1e-4)
    assert metrics["pose_error/tilt_deg/median"] == metrics["pose_error/tilt_deg/median_all"]
    for c in SENSOR:
        apart = sorted(abs(float(row[f"found_{c}"]) - float(row[f"true_{c}"])) for row in rows)
        assert metrics[f"sensor_error/{c}/median_all"] == pytest.approx(
            sum(apart[5:7]) / 2, rel=1e-4
        )
    # Other rays, far below the noise but not the same; and a sensor that hides decentres.
    assert 1e-4 < metrics["alignment/sampling_error_over_noise"] < 0.2
    assert metrics["alignment/pixel_grid_over_noise"] > 0.0
    for element in {row["true_element"] for row in rows}:
        assert metrics[f"alignment/bound_ratio/{element}/decenter_x_um"] > 3.0
        assert metrics[f"alignment/bound_ratio/{element}/tilt_x_deg"] > 1.0


def test_an_ideal_sensor_in_a_known_place_with_the_fits_own_rays(trained):
    ideal = ["pixel_pitch=0", "read_noise=0", "sensor_shift_range=0", "focus_range=0"]
    same = ["module.simulation_pupil.rings=4", "module.simulation_pupil.arms=16"]
    found = trained(*SMALL, *ideal, *same, "misalignments=4")
    metrics = found.metrics
    assert metrics["alignment/named_right"] == 1.0
    assert metrics["alignment/sampling_error_over_noise"] < 1e-9
    keys = set().union(*found.table("alignment"))
    assert not any("sensor" in key or "focus" in key for key in keys)
    assert not any(key.startswith("sensor") or "pixel_grid" in key for key in metrics)
    ratios = [value for key, value in metrics.items() if "bound_ratio" in key]
    assert ratios and ratios == pytest.approx([1.0] * len(ratios), rel=1e-9)


def test_focus_alone_may_be_unknown(trained):
    short = ["fields=[[0,0],[0,14]]", "misalignments=1", "module.iterations=2"]
    row = trained(*SMALL, *short, "sensor_shift_range=0").table("alignment")[0]
    assert "bound_focus_um" in row and "bound_sensor_x_um" not in row


PAIR = ("found", "true")
BAD_INPUT = {
    "demo.element=back": "demo.element: 'back' is unknown (allowed: front, middle, rear",
    "+demo.roll=1": "demo: unknown key 'roll'",
    "misalignments=0": "misalignments: 0; allowed: an integer of 1 or more",
    "tilt_range=0": "tilt_range: 0; allowed: a positive number",
    "photons=0": "photons: 0; allowed: a positive number",
    "sensor_shift_range=-1": "sensor_shift_range: -1; allowed: a positive number, or 0",
    "focus_range=inf": "focus_range: inf; allowed: a positive number, or 0",
    "pixel_pitch=-1": "pixel_pitch: -1; allowed: a positive number",
    "read_noise=-1": "read_noise: -1; allowed: 0 or more",
    "pixel_pitch=0": "read_noise: 2.0; allowed: 0 where pixel_pitch is 0",
    "window=1": "window: 1; light lands up to",
    "module.simulation_pupil.arms=7": "rings must be at least 1 and arms even, not 5 and 7",
    "fields=[]": "fields: none is given",
}


@pytest.mark.parametrize("override", BAD_INPUT)
def test_bad_input_gives_one_clear_line(refused, override):
    refused(BAD_INPUT[override], *SMALL, "fields=[[0,0]]", override)
