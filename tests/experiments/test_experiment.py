"""The contract between a run and its module: what a run refuses, and what an analysis leaves."""

import lightning
import pytest
import torch
from matplotlib.figure import Figure

from dolens.experiments.experiment import Analysis
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import QUIET

EXPERIMENT = """
# @package _global_
defaults:
  - /lens_only
  - override /module: null
  - override /lens: cooke_triplet
  - _self_

train: false
objective: efl_mm/spread
wavelengths: [486.1, 587.6, 656.3]
module:
  _target_: {target}
  _partial_: true
  _convert_: all
  wavelengths: ${{wavelengths}}
"""


class FocalLengths(Analysis):
    """An analysis that a user might write: the focal length at each wavelength."""

    def __init__(self, lens, wavelengths):
        super().__init__(lens)
        self.wavelengths = wavelengths
        self.rows = []

    def analyse(self):
        for wavelength in self.wavelengths:
            length = float(self.lens.first_order(float(wavelength)).efl)
            self.rows.append({"wavelength_nm": wavelength, "efl_mm": length})
            self.write_tables()
        lengths = [row["efl_mm"] for row in self.rows]
        return {"efl_mm/spread": max(lengths) - min(lengths)}

    def tables(self):
        return {"focal_lengths": self.rows, "nothing": []}

    def figures(self):
        return {"focal_lengths": self._draw}

    def _draw(self):
        figure = Figure()
        wavelengths, lengths = zip(*(row.values() for row in self.rows), strict=True)
        figure.subplots().plot(wavelengths, lengths)
        return figure


class Power(Analysis):
    """The derivative of the lens's power with respect to a curvature."""

    def __init__(self, lens, wavelengths):
        super().__init__(lens)

    def analyse(self):
        (curvature,) = self.lens.variables(["surfaces.1.curvature"]).values()
        curvature.requires_grad_()
        power = 1.0 / self.lens.first_order(587.6).efl
        (slope,) = torch.autograd.grad(power, curvature)
        return {"efl_mm/spread": float(slope)}


class Bare(lightning.LightningModule):
    """A module without the contract."""

    def __init__(self, lens, wavelengths):
        super().__init__()
        self.lens = lens


@pytest.fixture
def own(trained, tmp_path):
    """Run an experiment that a user keeps beside the repository, with a module of his own."""

    def build(module, *overrides):
        (tmp_path / "experiment").mkdir(exist_ok=True)
        text = EXPERIMENT.format(target=f"{__name__}.{module}")
        (tmp_path / "experiment/chromatic.yaml").write_text(text)
        quiet = [QUIET, f"hydra.searchpath=[file://{tmp_path}]"]
        return trained("experiment=chromatic", *quiet, *overrides)

    return build


def test_an_analysis_of_ones_own_leaves_its_numbers_tables_and_figures(own):
    found = own("FocalLengths")
    folder, spread = found.folder, found.objective
    assert found.metrics["efl_mm/spread"] == spread > 0.0
    rows = found.table("focal_lengths")
    lengths = [float(row["efl_mm"]) for row in rows]
    assert [row["wavelength_nm"] for row in rows] == ["486.1", "587.6", "656.3"]
    assert max(lengths) - min(lengths) == pytest.approx(spread, abs=2e-4)  # six digits
    assert not (folder / "nothing.csv").exists()
    assert [path.name for path in (folder / "figures").iterdir()] == ["focal_lengths.png"]
    assert found.info["status"] == "finished"


def test_an_analysis_may_differentiate(own):
    # Φ grows with the first curvature: its surface and those behind it add up.
    assert own("Power").objective > 0.0


def test_what_was_written_stays_when_a_later_part_fails(own, tmp_path):
    with pytest.raises(ValueError, match="red"):
        own("FocalLengths", "wavelengths=[587.6,red]")
    found = Finished(tmp_path / "run")
    assert len(found.table("focal_lengths")) == 1
    assert found.info["status"] == "failed"


REFUSED = {
    "a module without the contract": ("Bare", [], "module: Bare is no experiment; derive it from"),
    "training of an analysis": (
        "FocalLengths",
        ["train=true"],
        "train: FocalLengths trains nothing; set train=false",
    ),
    "a checkpoint for an analysis": (
        "FocalLengths",
        ["ckpt_path=any.ckpt"],
        "ckpt_path: FocalLengths trains nothing that a checkpoint could hold",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_run_cannot_do_is_one_clear_line(own, case):
    module, overrides, expected = REFUSED[case]
    with pytest.raises(ValueError) as caught:
        own(module, *overrides)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "experiment",
    [
        "chart_photographs",
        "cooke_sensitivity",
        "misalignment_coverage",
        "pose_accuracy",
        "pose_bounds",
        "speed_vs_error",
        "triplet_alignment",
    ],
)
def test_none_of_the_analyses_trains(refused, experiment):
    refused("trains nothing; set train=false", f"experiment={experiment}", "train=true")
