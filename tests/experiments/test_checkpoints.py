"""Checkpoints that are tested, taken up with other settings, and refused."""

import json
import shutil

import pytest
import torch

from dolens.experiments.running.checkpoints import SETTINGS
from dolens.experiments.running.training import run
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

TINY_CAMERA = [
    "experiment=wavefront_coding",
    *TINY,
    *TINY_NETWORK,
    "callbacks.pictures=null",
    "trainer.max_epochs=1",
]
UNTESTED = ["test=false", "objective=train/loss"]
ASPHERE = ["experiment=asphere", "callbacks.pictures=null"]


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder for the one camera that is trained for all tests."""
    return tmp_path_factory.mktemp("kept") / "trained"


@pytest.fixture
def trained(composed, tmp_path, kept):
    """The path of a trained camera's checkpoint."""
    if not kept.exists():
        run(composed(*TINY_CAMERA, "learning_rates.network=0.05", folder="trained"))
        shutil.copytree(tmp_path / "trained", kept)
    return kept / "checkpoints" / "last.ckpt"


def differences(caplog):
    """What one warning says of a checkpoint's settings; none: nothing."""
    found = [m for m in caplog.messages if "this run differs from the one that wrote" in m]
    assert len(found) <= 1
    return found[0].split("checkpoint: ")[1].split(". Weights")[0].split("; ") if found else []


def test_a_trained_camera_is_judged_by_its_checkpoint(composed, trained, kept, tmp_path, caplog):
    run(composed(*TINY_CAMERA, "train=false", f"ckpt_path={trained}", folder="judged"))
    first, judged = map(metrics_of, (kept, tmp_path / "judged"))
    tested = [name for name in first if name.startswith("test/")]
    assert tested
    for name in tested:
        assert judged[name] == first[name], name
    for name in ("x3", "x2y", "xy2", "y3"):
        key = f"variables/surfaces.5.{name}"
        assert judged[key] == first[key]
    assert (tmp_path / "judged/lens/final.yaml").read_text() == (
        kept / "lens/final.yaml"
    ).read_text()
    assert differences(caplog) == ["learning_rates.network is 0.002, was 0.05"]


def test_a_design_is_judged_by_its_best_round(composed, tmp_path):
    """The last round need not be the best one, whose lens a run leaves."""
    run(composed(*ASPHERE, folder="searched"))
    file = tmp_path / "searched" / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(file, weights_only=True)
    checkpoint["state_dict"]["variables.scaled"] *= 1.01
    torch.save(checkpoint, tmp_path / "moved.ckpt")
    run(composed(*ASPHERE, "train=false", f"ckpt_path={tmp_path / 'moved.ckpt'}", folder="judged"))
    first, judged = metrics_of(tmp_path / "searched"), metrics_of(tmp_path / "judged")
    for name in ("rms_spot_um/final", "rms_spot_um/initial", "light/final"):
        assert judged[name] == pytest.approx(first[name], rel=1e-12), name


@pytest.mark.parametrize("experiment", [TINY_CAMERA, ASPHERE], ids=["camera", "design"])
def test_what_was_never_trained_is_not_judged_as_if_it_had_been(refused, experiment):
    refused("dolens evaluate RUN", *experiment, "train=false")


IDLE = {
    "neither trains nor tests": [*TINY_CAMERA, "train=false", *UNTESTED],
    "a module that trains nothing": ["experiment=cooke_sensitivity"],
}


@pytest.mark.parametrize("case", IDLE)
def test_a_checkpoint_that_nothing_loads_is_an_error(refused, case, tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "any.ckpt")
    refused("ckpt_path: ", *IDLE[case], f"ckpt_path={tmp_path / 'any.ckpt'}")


def test_what_is_tested_passes_the_same_checks(refused, tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "any.ckpt")
    asked = [*TINY_CAMERA, "train=false"]
    refused("does not exist", *asked, "ckpt_path=nowhere.ckpt")
    refused("no checkpoint of a dolens", *asked, f"ckpt_path={tmp_path / 'any.ckpt'}")


def test_settings_that_differ_are_named_in_one_line(composed, trained, tmp_path, caplog):
    run(
        composed(
            *TINY_CAMERA,
            *UNTESTED,
            "trainer.max_epochs=2",
            f"ckpt_path={trained}",
            "seed=3",
            "learning_rates.network=0.01",
            "trainer.precision=bf16-mixed",
            folder="resumed",
        )
    )
    assert sorted(differences(caplog)) == [
        "learning_rates.network is 0.01, was 0.05",
        "seed is 3, was 0",
        "trainer.max_epochs is 2, was 1",
        "trainer.precision is 'bf16-mixed', was '32-true'",
    ]


def test_the_same_settings_are_passed_over_in_silence(composed, trained, caplog):
    same = [*TINY_CAMERA, "learning_rates.network=0.05"]
    run(composed(*same, "train=false", f"ckpt_path={trained}", "objective=test/psnr_db"))
    assert differences(caplog) == []


OTHERS = {
    "a radius": (["lens.surfaces.1.radius=60"], "lens.surfaces.1.radius is 60, was"),
    "another precision": (["lens_dtype=float64"], "lens_dtype is 'float64', was 'float32'"),
    "a wider network": (["network.width=8"], "has shape"),
    "another network": (["network=unet", "network.width=4", "network.depth=2"], "network"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_what_cannot_go_on_is_refused(refused, trained, case):
    overrides, expected = OTHERS[case]
    refused(expected, *TINY_CAMERA, *UNTESTED, *overrides, f"ckpt_path={trained}")


def test_a_design_of_another_lens_is_refused(composed, refused, tmp_path):
    run(composed(*ASPHERE, *UNTESTED, "objective=train/merit", "trainer.max_epochs=1", folder="a"))
    file = tmp_path / "a" / "checkpoints" / "last.ckpt"
    refused("lens.surfaces.1.radius is 20.5", *ASPHERE, "lens.surfaces.1.radius=20.5",
            f"ckpt_path={file}")  # fmt: skip


def test_an_old_checkpoint_is_taken_up_with_a_notice(composed, trained, tmp_path, caplog):
    checkpoint = torch.load(trained, weights_only=True)
    del checkpoint[SETTINGS]
    torch.save(checkpoint, tmp_path / "old.ckpt")
    asked = [*TINY_CAMERA, "train=false", f"ckpt_path={tmp_path / 'old.ckpt'}", "seed=1"]
    run(composed(*asked, folder="judged"))
    assert [m for m in caplog.messages if "does not say which settings it was written with" in m]
    assert differences(caplog) == []


def test_settings_in_a_checkpoint_are_plain_and_name_no_folder(trained, kept):
    settings = torch.load(trained, weights_only=True)[SETTINGS]
    assert settings["learning_rates.network"] == 0.05
    assert settings["views.seed"] == "${seed}"  # named once, where it is set
    assert str(kept.parent.parent) not in json.dumps(settings)
