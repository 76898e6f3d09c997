"""Which element is misaligned, as a run: table, metrics, figure, and bad input."""

import csv
import json
import math

import pytest

from dolens import InputError
from experiments.training import run

SMALL = [
    "experiment=triplet_alignment",
    "fields=[[0,0],[0,14],[-14,0],[14,-6]]",
    "misalignments=12",
    "module.rings=3",
    "module.arms=8",
    "+module.iterations=8",
    "+trainer.enable_progress_bar=false",
]
COLUMNS = ("tilt_x_deg", "tilt_y_deg", "decenter_x_um", "decenter_y_um")


def test_a_run_names_the_elements_and_its_table_agrees_with_its_metrics(composed, tmp_path):
    objective = run(composed(*SMALL))
    folder = tmp_path / "run"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert objective == metrics["alignment/named_right"] == 1.0
    assert metrics["alignment/converged"] == 1.0
    assert metrics["cost/batch_s"] > 0.0
    assert (folder / "figures" / "alignment.png").stat().st_size > 10_000
    with (folder / "alignment.csv").open(encoding="utf-8") as file:
        demo, *rows = csv.DictReader(file)
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
        for c in COLUMNS:
            difference = float(row[f"found_{c}"]) - float(row[f"true_{c}"])
            assert abs(difference) < 6.0 * float(row[f"bound_{c}"])
        errors.append(math.dist(*([float(row[f"{w}_{c}"]) for c in COLUMNS[:2]] for w in PAIR)))
    middle = sorted(errors)[5:7]
    assert metrics["pose_error/tilt_deg/median"] == pytest.approx(sum(middle) / 2, rel=1e-4)
    assert metrics["pose_error/tilt_deg/median"] == metrics["pose_error/tilt_deg/median_all"]


PAIR = ("found", "true")
BAD_INPUT = {
    "element": (["demo.element=back"], "demo.element: 'back'; allowed: front, middle, rear"),
    "key": (["+demo.roll=1"], "demo: 'roll' is unknown"),
    "count": (["misalignments=0"], "misalignments: 0; allowed: an integer of 1 or more"),
    "range": (["tilt_range=0"], "tilt_range: 0; allowed: a positive number"),
    "photons": (["photons=0"], "photons: 0.0; allowed: 1 or more"),
    "fields": (["fields=[]"], "fields, wavelengths: give at least one"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_gives_one_clear_line(composed, case):
    overrides, expected = BAD_INPUT[case]
    with pytest.raises(Exception) as caught:
        run(composed(*SMALL, "fields=[[0,0]]", *overrides))
    error = caught.value.__cause__ or caught.value
    assert isinstance(error, InputError), error
    assert expected in str(error) and "\n" not in str(error)
