"""Checkpoints that are tested, taken up with other settings, and refused."""

import json
import os
import pickle

import pytest
import torch
import yaml

from dolens.errors import InputError
from dolens.experiments.comparison.runs import read_run
from dolens.experiments.running.checkpoints import SETTINGS, read_checkpoint
from dolens.experiments.running.finished_run import load_run
from dolens.experiments.running.run_files import CONFIG, present_settings
from dolens.experiments.sweeps.job import refuse_other_settings
from tests.experiments.runs import Finished, change_setting
from tests.experiments.tiny_experiment import CAMERA, ONE_EPOCH, TRAINED, UNPICTURED, UNTESTED

ONCE = [*CAMERA, UNPICTURED, ONE_EPOCH]
JUDGED = [*ONCE, "train=false"]
ASPHERE = ["experiment=asphere", UNPICTURED]


@pytest.fixture(scope="module")
def first(tiny_run):
    return Finished(tiny_run)


def differences(caplog):
    """What one warning says of a checkpoint's settings; none: nothing."""
    found = [m for m in caplog.messages if "this run differs from the one that wrote" in m]
    assert len(found) <= 1
    return found[0].split("checkpoint: ")[1].split(". Weights")[0].split("; ") if found else []


def test_a_trained_camera_is_judged_by_its_checkpoint(trained, first, caplog):
    judged = trained(*JUDGED, f"ckpt_path={first.last}")
    plate = [f"variables/surfaces.5.{name}" for name in ("x3", "x2y", "xy2", "y3")]
    tested = [name for name in first.metrics if name.startswith("test/")]
    assert tested
    for name in (*tested, *plate):
        assert judged.metrics[name] == first.metrics[name], name
    lenses = [(run.folder / "lens/final.yaml").read_text() for run in (judged, first)]
    assert lenses[0] == lenses[1]
    assert differences(caplog) == ["learning_rates.network is 0.002, was 0.05"]


def test_a_design_is_judged_by_its_best_round(trained, tmp_path):
    """The last round need not be the best one, whose lens a run leaves."""
    searched = trained(*ASPHERE, folder="searched")
    checkpoint = searched.checkpoint()
    checkpoint["state_dict"]["variables.scaled"] *= 1.01
    torch.save(checkpoint, tmp_path / "moved.ckpt")
    judged = trained(*ASPHERE, "train=false", f"ckpt_path={tmp_path / 'moved.ckpt'}")
    for name in ("rms_spot_um/final", "rms_spot_um/initial", "light/final"):
        assert judged.metrics[name] == pytest.approx(searched.metrics[name], rel=1e-12), name


@pytest.mark.parametrize("experiment", [ONCE, ASPHERE], ids=["camera", "design"])
def test_what_was_never_trained_is_not_judged_as_if_it_had_been(refused, experiment):
    refused("dolens evaluate RUN", *experiment, "train=false")


class Bomb:
    """Its pickle leaves a folder where it is executed."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("form", ["zip", "before 1.6", "pickle"])
def test_a_checkpoint_that_would_execute_something_is_refused(tmp_path, form):
    file, executed = tmp_path / "a.ckpt", tmp_path / "executed"
    if form == "pickle":
        file.write_bytes(pickle.dumps(Bomb(executed), protocol=2))
    else:
        content = {"state_dict": Bomb(executed)}
        torch.save(content, file, _use_new_zipfile_serialization=form == "zip")
    with pytest.raises(InputError, match="is not a safe checkpoint") as error:
        read_checkpoint(file, "ckpt_path: ")
    assert str(error.value).startswith(f"ckpt_path: {file}") and "\n" not in str(error.value)
    assert "weights_only" not in str(error.value)
    assert not executed.exists()


# A checkpoint that nothing loads, and those that are none.
REFUSED = {
    "neither trains nor tests": ("ckpt_path: ", [*JUDGED, *UNTESTED], {"state_dict": {}}),
    "trains nothing": ("ckpt_path: ", ["experiment=cooke_sensitivity"], {"state_dict": {}}),
    "is not there": ("any.ckpt does not exist", JUDGED, None),
    "is another's": ("no checkpoint of a dolens", JUDGED, {"state_dict": {}}),
    "is a pickle": ("not a safe checkpoint", ONCE, {"state_dict": Bomb("executed")}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_run_refuses_a_checkpoint_in_one_line(refused, tmp_path, case):
    said, asked, content = REFUSED[case]
    if content is not None:
        torch.save(content, tmp_path / "any.ckpt")
    refused(said, *asked, f"ckpt_path={tmp_path / 'any.ckpt'}")


def test_a_run_of_old_is_read_as_one_of_now(trained, tiny_run, run_copy, caplog):
    """Modules were told their run's name and folder by two settings once."""
    gone = {
        "experiment": "${hydra:runtime.choices.experiment}",
        "folder": "${hydra:runtime.output_dir}",
    }
    config = yaml.safe_load((run_copy / CONFIG).read_text())
    config["module"] |= gone
    (run_copy / CONFIG).write_text(yaml.safe_dump(config, sort_keys=False))
    change_setting(run_copy, "module.experiment", "wavefront_coding")
    change_setting(run_copy, "module.folder", str(tiny_run))
    checkpoint = Finished(run_copy).checkpoint()
    checkpoint[SETTINGS] |= {f"module.{key}": value for key, value in gone.items()}
    torch.save(checkpoint, Finished(run_copy).last)

    assert load_run(run_copy).experiment == "wavefront_coding"
    old, new = read_run(run_copy), read_run(tiny_run)
    assert old.key() == new.key() and old.values.keys() == new.values.keys()
    refuse_other_settings(run_copy, (tiny_run / CONFIG).read_text())
    resumed = trained(
        *TRAINED, *UNTESTED, "trainer.max_epochs=2", f"ckpt_path={Finished(run_copy).last}"
    )
    assert differences(caplog) == ["trainer.max_epochs is 2, was 1"]
    assert resumed.checkpoint()["global_step"] == 4


@pytest.mark.parametrize(
    "settings",
    [
        {"module": {"_target_": "mine.Camera", "folder": "figures"}},
        {"module._target_": "mine.Camera", "module.folder": "figures"},
    ],
)
def test_a_module_of_one_s_own_may_have_a_folder(settings):
    assert present_settings(settings) == settings


def test_settings_that_differ_are_named_in_one_line(trained, first, caplog):
    other = ["seed=3", "learning_rates.network=0.01", "trainer.precision=bf16-mixed"]
    trained(*CAMERA, *UNTESTED, *other, f"ckpt_path={first.last}")
    assert sorted(differences(caplog)) == [
        "learning_rates.network is 0.01, was 0.05",
        "seed is 3, was 0",
        "trainer.max_epochs is 2, was 1",
        "trainer.precision is 'bf16-mixed', was '32-true'",
    ]


def test_the_same_settings_are_passed_over_in_silence(trained, first, caplog):
    same = [*TRAINED, UNPICTURED, "train=false", "objective=test/psnr_db"]
    trained(*same, f"ckpt_path={first.last}")
    assert differences(caplog) == []


OTHERS = {
    "a radius": (["lens.surfaces.1.radius=60"], "lens.surfaces.1.radius is 60, was"),
    "another precision": (["lens_dtype=float64"], "lens_dtype is 'float64', was 'float32'"),
    "a wider network": (["network.width=8"], "has shape"),
    "another network": (["network=unet", "network.width=4", "network.depth=2"], "network"),
    "another experiment": (
        ["experiment=wavefront_coding_baseline"],
        "experiment is 'wavefront_coding'",
    ),
}


@pytest.mark.parametrize("case", OTHERS)
def test_what_cannot_go_on_is_refused(refused, first, case):
    overrides, expected = OTHERS[case]
    camera = ONCE[1:] if case == "another experiment" else ONCE
    refused(expected, *camera, *UNTESTED, *overrides, f"ckpt_path={first.last}")


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ("lens.surfaces.1.radius=20.5", "lens.surfaces.1.radius is 20.5"),
        ("+variables={surfaces.2.curvature: null}", "the checkpoint's variables is"),
    ],
)
def test_a_checkpoint_of_another_design_is_refused(trained, refused, other, said):
    short = ["data.iterations=1", ONE_EPOCH, "test=false", "objective=train/merit"]
    last = trained(*ASPHERE, *short, folder="first").last
    refused(said, *ASPHERE, other, f"ckpt_path={last}")


def test_an_old_checkpoint_is_taken_up_with_a_notice(trained, first, tmp_path, caplog):
    checkpoint = first.checkpoint()
    del checkpoint[SETTINGS]
    torch.save(checkpoint, tmp_path / "old.ckpt")
    trained(*JUDGED, f"ckpt_path={tmp_path / 'old.ckpt'}", "seed=1")
    assert [m for m in caplog.messages if "does not say which settings it was written with" in m]
    assert differences(caplog) == []


def test_settings_in_a_checkpoint_are_plain_and_name_no_folder(first):
    settings = first.checkpoint()[SETTINGS]
    assert settings["learning_rates.network"] == 0.05
    assert settings["views.seed"] == "${seed}"  # named once, where it is set
    assert str(first.folder.parent.parent) not in json.dumps(settings)
