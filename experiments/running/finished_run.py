"""A run folder is loaded again as objects: the trained module, its lens and its data."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor

from dolens.errors import InputError, one_line
from dolens.experiments.camera.base import Camera
from dolens.experiments.experiment import Experiment, check_experiment
from dolens.experiments.running.checkpoints import (
    CHECKPOINTS,
    checkpoint_file,
    read_checkpoint,
    take_up,
)
from dolens.experiments.running.configuration import with_overrides
from dolens.experiments.running.recorded_run import RecordedRun, read_record
from dolens.experiments.running.refused_settings import refuse_unknown_keys, refuse_wrong_types
from dolens.experiments.running.run_files import RESOLVED
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.trust import needing_trust, refuse_untrusted
from dolens.experiments.running.user_configuration import import_extensions
from dolens.experiments.settings import register_resolvers
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription


@dataclass(frozen=True)
class FinishedRun:
    """A run, finished or not, as objects.

    Attributes:
        record: what the folder says of the run.
        cfg: the configuration, without interpolations; with overrides, where some were given.
        settings: the same, typed.
        module: what the configuration makes, with the state of the checkpoint, in evaluation mode.
        checkpoint: the file; None where the module trains nothing.
        step: training steps behind the checkpoint; 0 without one.
        epoch: epochs, likewise.
    """

    record: RecordedRun
    cfg: DictConfig
    settings: RunSettings
    module: Experiment
    checkpoint: Path | None
    step: int
    epoch: int

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.record.folder

    @property
    def status(self) -> str:
        """How the run ended: `finished`, `interrupted`, `failed`; or `running`."""
        return self.record.status

    @property
    def experiment(self) -> str:
        """The name of the experiment."""
        return self.record.experiment

    @property
    def lens(self) -> Lens:
        """The lens as the checkpoint has it."""
        return self.module.lens

    @cached_property
    def data(self) -> lightning.LightningDataModule:
        """The data module, made when it is asked for: its photographs need not be here.

        Raises:
            InputError: it cannot be made.
        """
        return self.made("data", self.settings.data)

    def made(self, key: str, config: DictConfig, **more: Any) -> Any:
        """Return what a part of the configuration makes.

        Args:
            key: of the part, for messages.
            config: the part.
            more: arguments besides.

        Raises:
            InputError: it cannot be made; one line that names the file.
        """
        try:
            with self.record.importable():
                return _made(key, config, **more)
        except InputError as error:
            raise InputError(f"{self.folder / RESOLVED}: {error}") from None


def load_run(
    folder: str | Path,
    checkpoint: str | Path = "last",
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
    with_loss: bool = True,
    trust: bool = False,
) -> FinishedRun:
    """Load a run folder as objects, in the state of a checkpoint.

    Parameters of the lens are those of the checkpoint, except where an override sets one to another
    value; whether overrides make another camera besides is not looked at here.

    The folder says which classes are made.  They are those of dolens, torch and Lightning, unless
    the run is trusted: a user's own ones are then looked for in the working folder and where Python
    looks, and the modules of `extensions` are imported.  The checkpoint is read as plain tensors
    and values.  Neither Hydra's job nor other global state is needed or changed; random numbers are
    left as they were.

    Args:
        folder: of the run.
        checkpoint: `last`, `best`, or the path of a file.
        overrides: as of the command line, applied over the run's own; see `with_overrides`.
        output: where paths of the configuration within the run folder lead to; None: the folder.
        with_loss: whether the loss is needed: a perceptual one looks for a classifier's weights.
        trust: whether the folder may call, import and write what it names; see `needing_trust`.

    Raises:
        InputError: the folder is none of a run, or needs trust; it has no such checkpoint; a class
            is not there; or the checkpoint is of another experiment, lens or network.
    """
    record = read_record(folder, output, trust)
    with record.importable():
        config = with_overrides(record, overrides)
    return load_recorded(record, config, checkpoint, with_loss)


def load_recorded(
    record: RecordedRun,
    config: Mapping[str, Any],
    checkpoint: str | Path = "last",
    with_loss: bool = True,
) -> FinishedRun:
    """Load a run as objects from its record; see `load_run`.

    Args:
        record: what the folder says.
        config: the configuration, without interpolations: the record's, or changed.
        checkpoint: as of `load_run`, and with_loss.
        with_loss: likewise.

    Raises:
        InputError: as of `load_run`.
    """
    register_resolvers()
    if not record.trusted:
        refuse_untrusted(needing_trust(config, record.output), record.folder)
    with record.importable():
        return _loaded(record, config, checkpoint, with_loss)


def _without_first_weights(config: Mapping[str, Any], with_loss: bool) -> dict[str, Any]:
    """A configuration of a module that looks for no trained weights to begin with.

    The checkpoint has all of the network's, and where the first ones came from need not be there.
    Without the loss, its classifier's weights are not looked for either.
    """
    found = copy.deepcopy(dict(config))
    network = _part(found, "reconstruction", "network")
    if {"weights", "weights_file"} <= set(network):
        network.update(weights="none", weights_file=None)
    loss = _part(found, "reconstruction", "loss")
    if "perceptual" in loss and not with_loss:
        loss["perceptual"] = "none"
    return found


def _part(node: Any, *keys: str) -> dict[str, Any]:
    """The mapping at a place; an empty one where there is none."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node if isinstance(node, dict) else {}


def _loaded(
    record: RecordedRun, config: Mapping[str, Any], checkpoint: str | Path, with_loss: bool
) -> FinishedRun:
    import_extensions(config.get("extensions"))
    try:
        cfg = OmegaConf.create(dict(config))
        settings = RunSettings.of(cfg)
        refuse_unknown_keys(config, ("module",))
        refuse_wrong_types(config, ("module",))
        made_of = OmegaConf.create(_without_first_weights(config["module"], with_loss))
        with torch.random.fork_rng(devices=()):
            module = _module(made_of, _lens(settings.prescription(), settings))
        check_experiment(module, train=False)
        module.place(record.experiment, record.output)
    except (InputError, OmegaConfBaseException) as error:
        where = f"; Python looks for classes in {Path.cwd()} and in the folders of PYTHONPATH"
        message = f"{record.folder / RESOLVED}: {one_line(error)}"
        raise InputError(message + (where if record.trusted else "")) from None
    file, state = None, {}
    if module.trains:
        file = checkpoint_file(record, checkpoint)
        state = read_checkpoint(file)
        values = state["state_dict"]
        if config["lens"] != record.config["lens"]:
            wanted = _lens(settings.prescription(), settings)
            recorded = _lens(record.config["lens"], settings)
            values = perturbed_state(module, wanted, recorded, values)
        take_up(module, {**state, "state_dict": values}, file)
    elif str(checkpoint) != CHECKPOINTS[0]:
        raise InputError(
            f"{record.folder}: {type(module).__name__} trains nothing, and has no checkpoint"
        )
    module.eval()
    step, epoch = int(state.get("global_step", 0)), int(state.get("epoch", -1)) + 1
    return FinishedRun(record, cfg, settings, module, file, step, epoch)


def _lens(prescription: Mapping[str, Any], settings: RunSettings) -> Lens:
    lens = lens_from_prescription(
        prescription, settings.dtype, where="lens", backend=settings.backend
    )
    return lens.in_state(settings.state)


def _module(config: DictConfig, lens: Lens) -> Experiment:
    make = _made("module", config)
    if not callable(make):
        raise InputError(
            "module: makes no experiment of a lens; allowed: _target_, _partial_: true"
        )
    try:
        return make(lens=lens)
    except InputError:
        raise
    except Exception as error:  # as Hydra's, of what it makes itself
        raise InputError(f"module: {type(error).__name__}: {one_line(error)}") from error


def _made(key: str, config: DictConfig, **more: Any) -> Any:
    """Return what a part of the configuration makes, with arguments besides.

    Raises:
        InputError: it cannot be made; one line with the reason.
    """
    try:
        return instantiate(config, **more)
    except HydraException as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise InputError(f"{key}: {' '.join(str(error).split())}") from error


_PREFIX = "lens."


def perturbed_state(
    module: Experiment, wanted: Lens, recorded: Lens, state: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return the state of a checkpoint with those values of the lens that a prescription changes.

    A parameter that the changed prescription has as the run's own is the checkpoint's; any other,
    and one that the run's lens does not have (an element's tilt), is that of the changed one.

    Args:
        module: made with the changed lens.
        wanted: the lens of the changed prescription.
        recorded: the lens of the run's own prescription.
        state: of the checkpoint.

    Raises:
        InputError: the module is no camera; a parameter that the run trained is changed, or another
            one while some follow by a solve or a pickup; or the lens has other surfaces.
    """
    if not isinstance(module, Camera):
        raise InputError(f"lens: {type(module).__name__} is no camera; only a camera's lens may be "
                         "set to other values")  # fmt: skip
    own, before = wanted.state_dict(), recorded.state_dict()
    if list(wanted.surfaces) != list(recorded.surfaces):
        raise InputError("lens: other surfaces make another lens, which the run did not train")
    changed = [
        name for name, value in own.items() if name not in before or not _same(value, before[name])
    ]
    trained = [name for name in changed if name in module.variables.names]
    if trained:
        raise InputError(
            f"lens: the run has trained {', '.join(trained)}; allowed: parameters that it has not"
        )
    if module.variables.dependents or module.variables.best_focus:
        raise InputError(
            "lens: some of the run's variables follow by a solve, and would follow the changed "
            "lens too; such a lens cannot be set to other values"
        )
    found = {name: value for name, value in state.items() if not name.startswith(_PREFIX)}
    for name, value in own.items():
        kept = name not in changed and f"{_PREFIX}{name}" in state
        found[f"{_PREFIX}{name}"] = state[f"{_PREFIX}{name}"] if kept else value
    return found


def _same(value: Any, other: Any) -> bool:
    return value.shape == other.shape and bool(torch.equal(value, other))
