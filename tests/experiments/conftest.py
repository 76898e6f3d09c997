import logging
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_repository import ConfigRepository
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, open_dict

from dolens.errors import InputError
from dolens.experiments import workers
from dolens.experiments.data import package_photographs
from dolens.experiments.data.photographs import read_photograph
from dolens.experiments.experiment import Experiment
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_module, run
from dolens.tasks import in_turn
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import CAMERA, TRAINED


@pytest.fixture(scope="session", autouse=True)
def quick_files() -> Iterator[None]:
    """No test cuts the power: nothing waits for a disk; and scikit-image's photographs, which do
    not change, are decoded once for all runs.
    """
    with (
        mock.patch.object(os, "fsync", lambda file: None),
        mock.patch.object(package_photographs, "read_photograph", cache(read_photograph)),
    ):
        yield


@pytest.fixture
def composed(root: Path, tmp_path: Path) -> Iterator[Callable[..., DictConfig]]:
    """Compose an experiment as train.py does, with its run folder under tmp_path."""
    with composing(root, tmp_path) as build:
        yield build


load_config, parsed = ConfigRepository.load_config, {}


def load_once(repository: ConfigRepository, config_path: str) -> ConfigResult | None:
    """Load a file of the configuration, which is parsed once for all tests.

    As a copy, since overrides are written into what Hydra has loaded: pickled, in a fifth of the
    time of `deepcopy`.
    """
    source = repository._find_object_source(config_path, ObjectType.CONFIG)
    # By its name: Hydra loads its plugins, and so their classes, once more than `import` does.
    if source is None or source.scheme() not in ("file", "pkg"):
        return load_config(repository, config_path)
    file = Path(source.path, f"{config_path.removesuffix('.yaml')}.yaml")
    written = file.stat().st_mtime_ns if source.scheme() == "file" else 0
    key = (file, written)
    if key not in parsed:
        parsed[key] = pickle.dumps(load_config(repository, config_path))
    return pickle.loads(parsed[key])


@contextmanager
def composing(root: Path, parent: Path) -> Iterator[Callable[..., DictConfig]]:
    """A function that composes an experiment with its run folder under a parent.

    Settings by name take the places of those that the overrides lead to.
    """

    def build(*overrides: str, folder: str = "run", **settings: Any) -> DictConfig:
        cfg = compose("train", list(overrides), return_hydra_config=True)
        output = parent / folder
        output.mkdir(exist_ok=True)
        with open_dict(cfg):
            cfg.update(settings)
            cfg.hydra.runtime.output_dir = str(output)
            cfg.hydra.job.num = 0
            pictures = (cfg.get("callbacks") or {}).get("pictures")
            own = any("pictures" in override for override in overrides)
            if isinstance(pictures, DictConfig) and not own:
                pictures.dpi = 80  # as many pixels as loggers get: seldom does a test look at them
        HydraConfig.instance().set_config(cfg)
        return cfg

    with (
        mock.patch.object(ConfigRepository, "load_config", load_once),
        initialize_config_dir(str(root / "conf"), version_base="1.3"),
    ):
        yield build
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None


@pytest.fixture
def trained(composed: Callable[..., DictConfig], tmp_path: Path) -> Callable[..., Finished]:
    """Run an experiment with overrides, as `composed` takes them, to its end."""

    def train(*overrides: str, folder: str = "run", **settings: Any) -> Finished:
        objective = run(composed(*overrides, folder=folder, **settings))
        return Finished(tmp_path / folder, objective)

    return train


@pytest.fixture
def made(composed: Callable[..., DictConfig]) -> Callable[..., Experiment]:
    """Make the module of an experiment, with its lens, and train nothing."""
    return lambda *overrides: build_module(RunSettings.of(composed(*overrides)))


@pytest.fixture(scope="session")
def tiny_run(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of a tiny camera; tests copy it, and write nothing into it."""
    return finished_run(root, tmp_path_factory.mktemp("finished"), *TRAINED)


@pytest.fixture
def run_copy(tiny_run: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be changed."""
    return Path(shutil.copytree(tiny_run, tmp_path / "run"))


@pytest.fixture(scope="session")
def two_epochs(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A tiny camera after two epochs of two steps, with pictures, and what its log said."""
    log, said = logging.getLogger("dolens"), []
    handler, level = logging.Handler(), log.level
    handler.emit = lambda record: said.append(record.getMessage())
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    parent = tmp_path_factory.mktemp("two_epochs")
    try:
        with composing(root, parent) as build:
            objective = run(build(*CAMERA))
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
    return Finished(parent / "run", objective, tuple(said))


def finished_run(root: Path, parent: Path, *overrides: str, name: str = "run") -> Path:
    """Train, and leave the whole run folder, with what Hydra writes into it for train.py."""
    with composing(root, parent) as build:
        cfg = build(*overrides, folder=name)
        records = parent / name / ".hydra"
        records.mkdir()
        OmegaConf.save(cfg.hydra.overrides.task, records / "overrides.yaml")
        OmegaConf.save(OmegaConf.create({"hydra": cfg.hydra}), records / "hydra.yaml")
        own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
        OmegaConf.save(own, records / "config.yaml")
        run(cfg)
    return parent / name


@pytest.fixture
def pickled_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every task goes through the form in which it would go to another process, and back."""

    def elsewhere(piece):
        function, task = pickle.loads(piece)
        return pickle.dumps(function(task))

    def pickled(function, tasks, name):
        pieces = [pickle.dumps((function, task)) for task in tasks]
        return map(pickle.loads, in_turn(elsewhere, pieces, name))

    monkeypatch.setattr(workers, "in_turn", pickled)


@pytest.fixture
def refused(composed: Callable[..., DictConfig]) -> Callable[..., None]:
    """Run with overrides, and see that it ends by one clear line that says what is expected."""

    def check(expected: str, *overrides: str) -> None:
        with pytest.raises(Exception) as caught:
            run(composed(*overrides))
        error = caught.value.__cause__ or caught.value
        assert isinstance(error, InputError), error
        assert expected in str(error) and "\n" not in str(error)

    return check
