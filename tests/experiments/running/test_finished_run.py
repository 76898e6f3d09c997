"""A run folder is loaded again as the camera that was trained, or refused in one line."""

import json

import pytest
import torch
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from dolens import load_lens
from dolens.errors import InputError
from dolens.experiments.running.finished_run import load_run


def refusal(folder, **options):
    with pytest.raises(InputError) as caught:
        load_run(folder, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def state_of(file):
    return torch.load(file, weights_only=True)["state_dict"]


def test_the_module_has_the_weights_and_the_lens_of_the_last_checkpoint(tiny_run):
    run = load_run(tiny_run)
    for name, value in state_of(tiny_run / "checkpoints/last.ckpt").items():
        assert torch.equal(run.module.state_dict()[name], value), name
    final = load_lens(tiny_run / "lens/final.yaml", dtype=torch.float32)
    assert torch.equal(run.lens.surfaces["5"].x3, final.surfaces["5"].x3.float())
    assert not torch.equal(run.lens.surfaces["5"].x3, torch.tensor(1.5e-5))  # where it began
    assert torch.equal(run.lens.sensor_distance, run.module.variables()["sensor_distance"])
    assert (run.status, run.experiment, run.step, run.epoch) == (
        "finished",
        "wavefront_coding",
        2,
        1,
    )
    assert run.checkpoint == tiny_run / "checkpoints/last.ckpt"
    assert not run.module.training


def test_loading_leaves_hydra_and_random_numbers_alone(tiny_run):
    assert not GlobalHydra.instance().is_initialized() and HydraConfig.instance().cfg is None
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    load_run(tiny_run, overrides=["light=50"])
    assert torch.equal(torch.rand(3), expected)
    assert not GlobalHydra.instance().is_initialized() and HydraConfig.instance().cfg is None


def test_another_checkpoint_is_loaded_by_its_name_or_path(run_copy, tmp_path):
    file = run_copy / "checkpoints/best.ckpt"
    checkpoint = torch.load(file, weights_only=True)
    checkpoint["state_dict"]["network.network.output.bias"] += 1.0
    torch.save(checkpoint, file)
    best = load_run(run_copy, checkpoint="best").module.state_dict()["network.network.output.bias"]
    by_path = load_run(run_copy, checkpoint=file).module.state_dict()["network.network.output.bias"]
    last = load_run(run_copy).module.state_dict()["network.network.output.bias"]
    assert torch.equal(best, by_path) and not torch.equal(best, last)


def test_a_folder_that_was_moved_writes_nothing_where_it_was(run_copy, tiny_run, tmp_path):
    run = load_run(run_copy)
    assert run.cfg.callbacks.pictures.folder == str(run_copy / "figures")
    assert str(tiny_run) not in json.dumps(yaml.safe_load(json.dumps(run.record.config)))
    elsewhere = load_run(run_copy, output=tmp_path / "out")
    assert elsewhere.cfg.callbacks.pictures.folder == str(tmp_path / "out/figures")


def test_overrides_are_applied_over_the_run_s_own(tiny_run):
    run = load_run(tiny_run, overrides=["light=50", "data=package_photographs"])
    assert run.cfg.readout.light == 50 and run.module.views.readout.exposure == 50 / 8180
    assert run.cfg.data["_target_"].endswith("PackagePhotographsDataModule")
    assert run.cfg.data.margin == 16  # what the run itself had set of its data
    assert "root" not in run.cfg.data
    assert run.cfg.network.width == 4


def test_a_run_keeps_its_own_settings_where_files_say_something_else_now(run_copy):
    """Only what an override changes is taken from the configuration's files."""
    file = run_copy / ".hydra/resolved.yaml"
    said = file.read_text()
    file.write_text(said.replace("noise_to_signal:\n  - 1.0", "noise_to_signal:\n  - 0.25"))
    assert file.read_text() != said
    assert load_run(run_copy, overrides=["light=50"]).cfg.network.noise_to_signal == [
        0.25,
        7.0,
        20.0,
    ]


def test_a_class_that_is_gone_names_the_commit_that_has_it(run_copy):
    file = run_copy / ".hydra/resolved.yaml"
    moved = "dolens.experiments.cameras_of_before."
    file.write_text(file.read_text().replace("dolens.experiments.camera.", moved))
    commit = json.loads((run_copy / "run.json").read_text())["git"]["commit"]
    for trust in (False, True):
        said = refusal(run_copy, trust=trust)
        assert f"has no {moved}" in said and f"the run was made by commit {commit}" in said


def test_what_is_no_run_is_refused_in_one_line(run_copy, tmp_path):
    assert "does not exist" in refusal(tmp_path / "nowhere")
    assert "is no folder" in refusal(run_copy / "run.json")
    assert "is no run folder: .hydra/resolved.yaml is missing" in refusal(run_copy / "lens")
    assert "holds 1 runs and is none itself; name one of them" in refusal(tmp_path)


def test_a_checkpoint_that_is_missing_or_unsafe_is_refused(run_copy):
    (run_copy / "checkpoints/best.ckpt").write_text("no checkpoint")
    assert "best.ckpt is not a safe checkpoint" in refusal(run_copy, checkpoint="best")
    (run_copy / "checkpoints/last.ckpt").unlink()
    assert "has no checkpoint checkpoints/last.ckpt; there is best" in refusal(run_copy)
    assert "best, or the path of a file" in refusal(run_copy, checkpoint="other.ckpt")


def test_a_checkpoint_of_another_camera_is_refused(run_copy, tiny_run):
    file = run_copy / ".hydra/resolved.yaml"
    whole = file.read_text()
    file.write_text(whole.replace("width: 4\n", "width: 8\n"))
    assert "has shape (4, 6, 3, 3) in the checkpoint and (8, 6, 3, 3) here" in refusal(run_copy)
    file.write_text(whole.replace("name: Achromatic", "name: Other"))
    assert "the checkpoint's lens is 'Achromatic" in refusal(run_copy)


def test_a_class_of_one_s_own_is_looked_for_in_the_working_folder(run_copy, tmp_path, monkeypatch):
    file = run_copy / ".hydra/resolved.yaml"
    own = "loss_of_a_user.Own"
    file.write_text(file.read_text().replace("dolens.reconstruction.RestorationLoss", own))
    assert own in file.read_text()
    assert f"would call {own} (loss)" in refusal(run_copy)
    assert f"'{own}' cannot be found" in refusal(run_copy, trust=True)
    (tmp_path / "loss_of_a_user.py").write_text(
        "import dolens.reconstruction\nOwn = dolens.reconstruction.RestorationLoss\n"
    )
    monkeypatch.chdir(tmp_path)
    assert load_run(run_copy, trust=True).step == 2


def test_overrides_that_cannot_be_applied_are_refused(tiny_run):
    assert "there is no such setting" in refusal(tiny_run, overrides=["readout.bitz=3"])
    assert "nothing in experiment=wavefront_coding reads" in refusal(
        tiny_run, overrides=["+nonsense=3"]
    )
    assert "data=nowhere: there is no such file" in refusal(tiny_run, overrides=["data=nowhere"])
