"""Settings of a run: its objective, which it must have, its loggers, and its lens."""

import json
import logging
import math
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from dolens.errors import InputError
from dolens.experiments.callbacks.interruption import LoggedObjectives
from dolens.experiments.design.design import DesignModule
from dolens.experiments.experiment import Experiment
from dolens.experiments.running.command_line import no_choice
from dolens.experiments.running.refused_settings import names_of_targets
from dolens.experiments.running.run_settings import RunSettings, is_among, refuse_unknown, returned
from dolens.experiments.running.training import build_lens, build_module
from tests.experiments.tiny_experiment import TRAINED

KNOWN = ("test/psnr_db", "test/psnr_db/worst", "train/*")


def test_an_objective_with_a_wrong_letter_is_refused_with_the_name_that_is_near():
    with pytest.raises(InputError) as error:
        refuse_unknown(["test/psnr_db/wrst"], KNOWN, ["dolens.a.B", "torch.optim.Adam"])
    assert str(error.value) == (
        "objective: 'test/psnr_db/wrst' is no metric of this run; did you mean "
        "'test/psnr_db/worst'? (there are: test/psnr_db, test/psnr_db/worst)"
    )


def test_an_objective_of_no_kind_that_there_is_is_refused_with_all_kinds():
    with pytest.raises(InputError, match=r"'foo' is no metric .*test/\.\.\., train/.*cost/"):
        refuse_unknown(["foo"], KNOWN, [])


def test_what_a_run_will_have_or_may_have_is_taken(caplog):
    refuse_unknown(["test/psnr_db/worst", "train/anything", "cost/step_s"], KNOWN, [])
    refuse_unknown(["foo"], None, [])  # nothing is known of an experiment of the user's own
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        refuse_unknown(["mine/number"], KNOWN, ["dolens.a.B", "mine.Callback"])
    assert "'mine/number' is no metric" in caplog.text and "mine.Callback logs it" in caplog.text


def test_the_end_of_a_run_names_what_is_near():
    with pytest.raises(InputError, match="did you mean 'train/merit'"):
        returned(["train/mert"], {"train/merit": 1.0, "val/merit": 2.0})


def test_an_experiment_says_its_metrics_or_that_they_are_not_known():
    assert Experiment.metrics is None
    assert is_among("rms_spot_um/final", DesignModule.metrics)
    assert not is_among("rms_spot_um/finl", DesignModule.metrics)


def test_every_metric_of_a_finished_camera_was_named_before(composed, tiny_run):
    cfg = composed(*TRAINED)
    settings = RunSettings.of(cfg)
    known = build_module(settings).metric_names()
    metrics = json.loads((tiny_run / "metrics.json").read_text())
    own = [name for name in metrics if not name.startswith("cost/")]
    assert own and [name for name in own if not is_among(name, known)] == []
    assert settings.objectives[0] in known
    assert "torch.optim.Adam" in names_of_targets(cfg, ["module"])


@pytest.mark.parametrize(("objective", "there"), [("val/psnr", "val/psnr_db"), ("val/x", None)])
def test_an_objective_that_validation_lacks_ends_the_run_there(objective, there):
    callback = LoggedObjectives(["test/psnr_db", objective])
    trainer = SimpleNamespace(
        sanity_checking=True, callback_metrics={"train/loss": 1.0} | ({there: 2.0} if there else {})
    )
    callback.on_validation_end(trainer, None)  # Lightning's trial before the first step
    trainer.sanity_checking = False
    with pytest.raises(InputError, match=f"^objective: '{objective}' is no metric of this run"):
        callback.on_validation_end(trainer, None)


def test_loggers_are_none_by_name_and_null_is_explained(composed):
    assert composed("experiment=asphere", "logger=none").logger is None
    assert no_choice(["-m", "experiment=asphere", "logger=null"]) == (
        "logger=null: logger is chosen by the name of a file "
        "(there are: mlflow, none, tensorboard, wandb)"
    )
    assert no_choice(["experiment=asphere", "seed=3"]) is None


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("N-BK7", "SCHOTT:N-BK7"),
        ("ohara:S-BSL7", "OHARA:S-BSL7"),
        ("1.5", "1.5"),
        ("PC", "PLASTIC:POLYCARBONATE"),
    ],
)
def test_a_material_on_the_command_line(composed, written, name):
    cfg = composed("experiment=wavefront_coding", f"lens.surfaces.1.material={written}")
    assert build_lens(RunSettings.of(cfg)).materials[1].name == name


def test_an_element_on_the_command_line(composed):
    """The README's own words."""
    front = "+lens.elements.front={surfaces: [1, 3], tilt_x: 0.1, decenter_y: 0.05}"
    lens = build_lens(RunSettings.of(composed("experiment=wavefront_coding", front)))
    assert (lens.elements["front"].first, lens.elements["front"].last) == (1, 3)
    tilt = lens.variables(["elements.front.tilt_x"])["elements.front.tilt_x"]
    assert float(tilt.detach()) == pytest.approx(math.radians(0.1), rel=1e-6)


def test_a_configuration_may_name_a_table_of_cells_as_a_file(tmp_path, monkeypatch):
    (tmp_path / "pillars.csv").write_text(
        "width_nm wavelength_nm phase_rad power\n80 532 0.1 0.9\n120 532 0.7 0.8\n"
    )
    monkeypatch.chdir(tmp_path)
    lens = {"surfaces": {"1": {"diffractive": {"cells": "pillars.csv", "pitch": 0.0004}}}}
    settings = SimpleNamespace(lens=OmegaConf.create(lens))
    found = RunSettings.prescription(settings)["surfaces"]["1"]["diffractive"]
    assert found["pitch"] == 0.0004
    assert [row[:3] for row in found["cells"][1:]] == [[80.0, 532.0, 0.1], [120.0, 532.0, 0.7]]
