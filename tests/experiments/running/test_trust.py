"""A stranger's run folder is data: what it may call, import and write is known beforehand."""

import os
import pkgutil
import sys
from pathlib import Path

import pytest
import yaml
from lightning import Trainer

from dolens.errors import InputError
from dolens.experiments.commands.apply import apply_run
from dolens.experiments.commands.apply_options import Options
from dolens.experiments.commands.evaluate import evaluate
from dolens.experiments.commands.export import ExportSettings, export_run
from dolens.experiments.running.finished_run import load_run
from dolens.experiments.running.run_files import walk
from dolens.experiments.running.trust import allowed_targets, needing_trust
from tests.experiments.runs import change_setting

COMMANDS = {
    "apply": lambda folder, picture, **trust: apply_run(folder, [picture], Options(), **trust),
    "evaluate": lambda folder, picture, **trust: evaluate(folder, name="again", **trust),
    "evaluate otherwise": lambda folder, picture, **trust: evaluate(folder, ["light=50"], **trust),
    "export": lambda folder, picture, trust=False: export_run(
        folder, settings=ExportSettings(["yaml"], trust=trust)
    ),
}
CALLS = {
    "a module of the working folder": {"_target_": "module_of_a_stranger.anything"},
    "a shell": {"_target_": "os.system", "command": "touch executed"},
    "a folder": {"_target_": "os.mkdir", "_args_": ["executed"]},
    "a file": {"_target_": "io.open", "file": "executed", "mode": "w"},
    "a built-in": {"_target_": "builtins.open", "file": "executed", "mode": "w"},
    "evaluation": {"_target_": "builtins.eval", "_args_": ["open('executed', 'w')"]},
    "a table": {"_target_": "numpy.savetxt", "fname": "executed", "X": [1.0]},
    "a document": {"_target_": "numpy.testing.rundocs", "filename": "module_of_a_stranger.py"},
    "a hub": {"_target_": "torch.hub.load", "repo_or_dir": ".", "model": "a", "source": "local"},
    "a pickle": {"_target_": "torch.load", "f": "stranger.pt", "weights_only": False},
    "an extension": {"_target_": "torch.utils.cpp_extension.load", "name": "a", "sources": []},
    "by way of dolens": {
        "_target_": "dolens.experiments.running.finished_run.torch.hub.load",
        "repo_or_dir": ".",
        "model": "a",
        "source": "local",
    },
    "a function of dolens": {
        "_target_": "dolens.experiments.running.user_configuration.import_extensions",
        "modules": ["module_of_a_stranger"],
    },
    "another one": {"_target_": "dolens.prescriptions.save_lens", "path": "executed"},
    "the command": {"_target_": "dolens.cli.__main__"},
    "a method of a class": {"_target_": "torch.nn.Module.register_module"},
    "an attribute of a class": {"_target_": "torch.nn.Linear.__init__.__globals__.get"},
    "a class's loader": {"_target_": "torch.nn.Embedding.from_pretrained"},
    "a checkpoint": {
        "_target_": "dolens.experiments.camera.camera.CameraModule.load_from_checkpoint",
        "checkpoint_path": "stranger.pt",
    },
    "Hydra's own": {"_target_": "hydra.utils.get_method", "path": "os.system"},
    "Hydra's other one": {"_target_": "hydra.utils.instantiate", "config": {}},
    "a partial": {"_target_": "functools.partial", "_partial_": True},
    "within a call": {"_target_": "torch.nn.Identity", "a": {"_target_": "os.getcwd"}},
    "within a list": {"some": [{"more": [{"_target_": "os.getcwd"}]}]},
    "later": {"_target_": "torch.nn.Identity", "_recursive_": False, "a": {"_target_": "os.abort"}},
    "no name": {"_target_": ["os.getcwd"]},
    "a name with a space": {"_target_": "torch.nn.Identity "},
    "without names": {"_target_": "torch.nn.Identity", "_args_": [1]},
}
SETTINGS = {
    "extensions": ["module_of_a_stranger"],
    "extensions as a text": "module_of_a_stranger",
    "callbacks.pictures.folder": "/tmp/elsewhere",
    "callbacks.best.dirpath": "../elsewhere",
    "trainer.default_root_dir": "~",
    "module.cameras.settings": ["experiment=camera", "+callbacks.a._target_=os.system"],
    "module.cameras.more.settings": ["network=../../module_of_a_stranger"],
    "module.other.settings": ["extensions=[module_of_a_stranger]"],
    "module.others.settings": ["hydra.searchpath=[pkg://module_of_a_stranger]"],
}


@pytest.fixture
def folder(run_copy, tmp_path, monkeypatch):
    """A copy of a run; the working folder is a stranger's, with a module and a picture in it."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    Path("module_of_a_stranger.py").write_text("open('executed', 'w')\n")
    Path("hubconf.py").write_text("open('executed', 'w')\n")
    return run_copy


def refusals(folder, picture):
    """What each command says as it refuses the run, before anything is imported or called."""
    for name, command in COMMANDS.items():
        with pytest.raises(InputError) as caught:
            command(folder, picture)
        assert "\n" not in str(caught.value), name
        yield str(caught.value)
    assert not Path("executed").exists()
    assert not {"module_of_a_stranger", "hubconf"} & set(sys.modules)


@pytest.mark.parametrize(
    "call, place",
    [(call, "callbacks.mine") for call in CALLS]
    + [
        ("a hub", place)
        for place in ("module.reconstruction.loss", "module", "data", "odd", "lens")
    ],
)
def test_what_is_not_on_the_list_is_not_called(call, place, folder, root):
    change_setting(folder, place, CALLS[call])
    for message in refusals(folder, root / "docs/lenses.png"):
        assert "would call" in message or "would give a call" in message
        assert "--trust (in Python, trust=True) allows it" in message


@pytest.mark.parametrize("setting", SETTINGS)
def test_other_settings_that_execute_or_write_elsewhere_need_trust(setting, folder, root):
    change_setting(folder, setting.removesuffix(" as a text"), SETTINGS[setting])
    for message in refusals(folder, root / "docs/lenses.png"):
        verb = {"ex": "import", "mo": "start dolens train"}.get(setting[:2], "write into")
        assert f"run would {verb}" in message and "--trust" in message


def test_overrides_of_a_stranger_call_nothing_either(folder, root):
    file = folder / ".hydra/overrides.yaml"
    own = yaml.safe_load(file.read_text())
    for added, said in (
        ("+callbacks.a={_target_:module_of_a_stranger.a}", "call module_of_a_stranger.a"),
        ("+extensions=[module_of_a_stranger]", "import module_of_a_stranger"),
        ("hydra.searchpath=[pkg://module_of_a_stranger]", "a setting of Hydra's own"),
        ("++hydra.searchpath=[pkg://module_of_a_stranger]", "a setting of Hydra's own"),
    ):
        file.write_text(yaml.safe_dump([*own, added]))
        with pytest.raises(InputError, match=said):
            evaluate(folder, ["light=50"])
    assert "module_of_a_stranger" not in sys.modules


def test_a_configuration_of_a_stranger_is_not_composed(folder, tmp_path):
    conf = tmp_path / "conf"
    conf.mkdir()
    (conf / "train.yaml").write_text("hydra: {searchpath: [pkg://module_of_a_stranger]}\n")
    file = folder / ".hydra/hydra.yaml"
    job = yaml.safe_load(file.read_text())
    job["hydra"]["runtime"]["config_sources"].insert(0, {"path": str(conf), "schema": "file"})
    file.write_text(yaml.safe_dump(job))
    with pytest.raises(InputError, match=f"would be composed of {conf}"):
        evaluate(folder, ["light=50"])
    assert "module_of_a_stranger" not in sys.modules


@pytest.mark.parametrize("written", ["${oc.env:HOME}", "${seed}", "${hydra:runtime.cwd}", "a${b"])
def test_a_resolved_configuration_asks_for_nothing(folder, root, written):
    change_setting(folder, "data.odd", written)
    for message in refusals(folder, root / "docs/lenses.png"):
        assert "resolved.yaml: data.odd is" in message and "not resolved" in message


def test_results_are_not_written_through_links(folder, root, tmp_path):
    kept = tmp_path / "kept"
    kept.write_text("kept")
    for name in ("applied/lenses_sensor.png", "evaluation", "export/lens.yaml"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(kept)
    for message in refusals(folder, root / "docs/lenses.png"):
        assert "is a link, and would be written through" in message
    assert kept.read_text() == "kept"


def test_a_module_of_one_s_own_is_imported_where_the_run_is_trusted(folder):
    change_setting(folder, "extensions", ["module_of_a_stranger"])
    assert load_run(folder, trust=True).step == 2
    assert Path("executed").exists() and sys.modules.pop("module_of_a_stranger")


@pytest.mark.parametrize(
    "settings",
    [
        {"devices": 8, "accelerator": "cpu"},
        {"devices": "auto", "strategy": "ddp", "accelerator": "cpu"},
        {"devices": 2, "num_nodes": 3, "strategy": "ddp_spawn", "accelerator": "cpu"},
        {"devices": [0, 1], "strategy": "fsdp", "accelerator": "cpu"},
    ],
)
def test_a_run_of_many_processes_is_evaluated_in_one(settings, folder, monkeypatch):
    for key, value in settings.items():
        change_setting(folder, f"trainer.{key}", value)
    made = []
    monkeypatch.setattr(Trainer, "test", lambda trainer, *_, **__: made.append(trainer))
    evaluate(folder, name="again")
    (trainer,) = made
    assert (trainer.world_size, trainer.num_nodes, trainer.strategy.launcher) == (1, 1, None)


def test_no_more_processes_cut_crops_than_there_are_processors(folder, monkeypatch):
    change_setting(folder, "data.num_workers", 1000)
    made = []
    monkeypatch.setattr(Trainer, "test", lambda trainer, module, data, **_: made.append(data))
    evaluate(folder, name="again")
    (data,) = made
    assert data.num_workers == os.cpu_count()


@pytest.mark.parametrize("key", ["plugins", "strategy", "accelerator", "profiler", "logger"])
def test_parts_of_a_trainer_that_a_stranger_names_are_not_made(key, folder, root):
    call = {"_target_": f"lightning.pytorch.{key}.Anything", "cluster": {"_target_": "os.fork"}}
    change_setting(folder, f"trainer.{key}", [call])
    for message in refusals(folder, root / "docs/lenses.png"):
        assert f"would call lightning.pytorch.{key}.Anything (trainer.{key}" in message


def configuration_files(root):
    for file in sorted((root / "conf").rglob("*.yaml")):
        if file.relative_to(root / "conf").parts[0] not in (
            "hydra",
            "search",
            "lens",
            "train.yaml",
        ):
            yield file, yaml.safe_load(file.read_text())


def test_all_that_dolens_configures_is_on_the_list(root):
    """And needs no trust, whatever is chosen."""
    for file, content in configuration_files(root):
        assert not needing_trust(content or {}), file
    named = {
        v for _, c in configuration_files(root) for p, v, _ in walk("", c) if p[-8:] == "_target_"
    }
    assert len(named) > 60 and "dolens.reconstruction.RestorationLoss" in named


def test_the_list_has_classes_of_dolens_torch_and_lightning_alone():
    homes = ("dolens.", "torch.nn.", "torch.optim", "lightning.", "datetime")
    for name in allowed_targets():
        made = pkgutil.resolve_name(name)
        assert callable(made) and made.__module__.startswith(homes), name
        assert isinstance(made, type) or name.startswith("dolens."), name
    names = ("torch.optim.AdamW", "torch.nn.Conv2d", "torch.optim.lr_scheduler.OneCycleLR")
    assert set(names) < allowed_targets()
    assert not {"torch.load", "torch.nn.functional.relu", "os.system"} & allowed_targets()
