"""The contract between a run and its module: what a run refuses, and what an analysis leaves."""

import csv
import json

import lightning
import pytest
import torch

from experiments.analysis import Analysis
from experiments.running.training import run

TOLERANCES = ["experiment=cooke_sensitivity", "+trainer.enable_progress_bar=false"]


class FocalLengths(Analysis):
    """An analysis that a user might write: the focal length at each wavelength."""

    def __init__(self, lens, experiment, folder, wavelengths):
        super().__init__(lens, experiment, folder)
        self.wavelengths = wavelengths
        self.rows = []

    def analyse(self):
        for wavelength in self.wavelengths:
            power = 1.0 / self.lens.first_order(wavelength).efl
            self.rows.append({"wavelength_nm": wavelength, "efl_mm": float(1.0 / power)})
            self.write_tables()
        lengths = [row["efl_mm"] for row in self.rows]
        return {"efl_mm/spread": max(lengths) - min(lengths)}

    def tables(self):
        return {"focal_lengths": self.rows, "nothing": []}


class Differentiated(Analysis):
    """The derivative of the focal length with respect to a curvature, by autograd."""

    def analyse(self):
        (curvature,) = self.lens.variables(["surfaces.1.curvature"]).values()
        value = curvature.detach().clone().requires_grad_()
        system = self.lens.system({"surfaces.1.curvature": value})
        assert system is not None
        torch.sin(value).backward()
        return {"slope": float(value.grad)}


class Bare(lightning.LightningModule):
    """A module without the contract."""

    def __init__(self, lens):
        super().__init__()
        self.lens = lens


def composed_with(composed, module, *overrides, **settings):
    cfg = composed(*TOLERANCES, "callbacks=null", "objective=efl_mm/spread", *overrides)
    cfg.module = {"_target_": f"{__name__}.{module}", "_partial_": True, **settings}
    return cfg


def own_analysis(composed, tmp_path, *overrides, **settings):
    return composed_with(
        composed,
        "FocalLengths",
        *overrides,
        **{
            "experiment": "chromatic",
            "folder": str(tmp_path / "run"),
            "wavelengths": [486.1, 587.6, 656.3],
            **settings,
        },
    )


def table(folder, name):
    with (folder / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_an_analysis_of_ones_own_leaves_its_numbers_and_tables(composed, tmp_path):
    spread = run(own_analysis(composed, tmp_path))
    folder = tmp_path / "run"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["efl_mm/spread"] == spread > 0.0
    rows = table(folder, "focal_lengths")
    lengths = [float(row["efl_mm"]) for row in rows]
    assert [row["wavelength_nm"] for row in rows] == ["486.1", "587.6", "656.3"]
    assert max(lengths) - min(lengths) == pytest.approx(spread, rel=1e-3)
    assert not (folder / "nothing.csv").exists()
    assert json.loads((folder / "run.json").read_text())["status"] == "finished"


def test_what_was_written_stays_when_a_later_part_fails(composed, tmp_path):
    with pytest.raises(Exception, match="wavelength"):
        run(own_analysis(composed, tmp_path, wavelengths=[587.6, "red"]))
    assert len(table(tmp_path / "run", "focal_lengths")) == 1
    assert json.loads((tmp_path / "run/run.json").read_text())["status"] == "failed"
