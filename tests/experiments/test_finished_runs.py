"""What a finished run leaves in its logs and metrics, whatever failed beside it."""

import json

import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.running.training import run
from dolens.reconstruction import RestorationLoss
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

TINY_CAMERA = ["experiment=wavefront_coding", *TINY, *TINY_NETWORK, "callbacks.pictures=null"]
UNTESTED = ["test=false", "objective=train/loss"]


class OwnLoss(torch.nn.Module):
    """A loss that a user might write: a total, and nothing else."""

    def forward(self, restored, truth):
        return {"total": (restored - truth).square().mean()}


def loaded(folder):
    found = EventAccumulator(str(folder / "tensorboard"))
    found.Reload()
    return found


def test_a_default_loader_shows_every_point_of_a_camera(composed, tmp_path):
    run(composed(*TINY_CAMERA))
    log = loaded(tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    # Four steps, logged each; once more with the hyper-parameters, at the end.
    for name in ("train/loss", "variables/surfaces.5.x3"):
        steps = [point.step for point in log.Scalars(name)]
        assert steps == [0, 1, 2, 3, 4], name
    assert [point.step for point in log.Scalars("val/psnr_db")][-1] == 4
    assert len(log.Scalars("val/psnr_db")) == 3
    for name, value in metrics.items():
        assert log.Scalars(name)[-1].value == pytest.approx(value, rel=1e-6), name


def test_the_table_of_runs_has_what_was_chosen_and_the_objective_first(composed, tmp_path):
    given = ("lens.surfaces.1.radius=25.1", "trainer.max_epochs=1", "data.scale_range=[1.0,1.5]")
    run(composed(*TINY_CAMERA, *UNTESTED, *given, "network.width=6"))
    files = (tmp_path / "run" / "tensorboard").rglob("events.*")
    assert len({file.parent for file in files}) == 1  # each folder is a run to TensorBoard
    summary = loaded(tmp_path / "run")
    found = summary.PluginTagToContent("hparams")
    # A list of columns of this run would be taken for that of all runs.
    assert set(found) == {"_hparams_/session_start_info", "_hparams_/session_end_info"}
    content = plugin_data_pb2.HParamsPluginData.FromString(found["_hparams_/session_start_info"])
    columns = content.session_start_info.hparams
    assert columns["lens.surfaces.1.radius"].number_value == 25.1
    assert columns["trainer.max_epochs"].number_value == 1
    assert columns["network.width"].number_value == 6
    assert columns["data.scale_range"].string_value == "[1.0, 1.5]"
    assert columns["experiment"].string_value == "wavefront_coding"
    assert columns["network"].string_value == "feature_wiener"
    assert columns["seed"].number_value == 0
    assert not [name for name in columns if name.startswith(("callbacks", "logger", "hydra"))]
    assert len(columns) < 50
    # TensorBoard sorts the numbers by name: a capital letter comes before all others.
    assert sorted(summary.Tags()["scalars"])[0] == "Objective"


def test_the_text_of_a_run_has_all_its_settings(composed, tmp_path):
    run(composed(*TINY_CAMERA, *UNTESTED, "trainer.max_epochs=1"))
    log = loaded(tmp_path / "run")
    (text,) = log.Tensors("settings/text_summary")
    settings = yaml.safe_load(
        text.tensor_proto.string_val[0].decode().strip("`").removeprefix("yaml")
    )
    assert settings["learning_rates.optics"] > 0.0 and settings["trainer.max_epochs"] == 1
    assert settings["lens.surfaces.1.radius"] != 0.0


def test_a_default_loader_shows_every_iteration_of_a_design(composed, tmp_path):
    run(composed("experiment=asphere", "callbacks.pictures=null"))
    log = loaded(tmp_path / "run")
    iterations = json.loads((tmp_path / "run" / "metrics.json").read_text())["cost/iterations"]
    points = [point.step for point in log.Scalars("train/merit")]
    assert points == sorted(points)
    assert len(points) == iterations + 1


def test_a_loss_of_ones_own_needs_no_word_about_perception(composed, tmp_path, monkeypatch):
    cfg = composed(*TINY_CAMERA, "trainer.max_epochs=1")
    cfg.loss = {"_target_": f"{__name__}.OwnLoss"}
    run(cfg)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert "test/psnr_db" in metrics
    assert "loss/perceptual_available" not in metrics
    assert not hasattr(OwnLoss(), "perceptual_available")
    assert hasattr(RestorationLoss, "perceptual_available")


def test_a_summary_that_fails_loses_only_itself(composed, tmp_path, monkeypatch, caplog):
    def fails(self):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(CameraModule, "summary", fails)
    objective = run(composed(*TINY_CAMERA, "trainer.max_epochs=1"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["test/psnr_db/worst"] == objective
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "finished"
    (record,) = [r for r in caplog.records if "summary() failed" in r.getMessage()]
    assert record.levelname == "ERROR" and record.exc_info[0] is ZeroDivisionError
