"""A run folder loaded again as objects: the trained module, its lens and its data."""

import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError
from dolens.experiments.experiment import Experiment, check_experiment
from dolens.experiments.running.composition import with_overrides
from dolens.experiments.running.extensions import import_extensions
from dolens.experiments.running.recorded_run import RecordedRun, read_record
from dolens.experiments.running.resolvers import register_resolvers
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.target_keys import refuse_unknown_keys
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription

logger = logging.getLogger(__name__)

CHECKPOINTS = ("last", "best")


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
        with working_folder_importable():
            return _made("data", self.settings.data)


def load_run(
    folder: str | Path,
    checkpoint: str | Path = "last",
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
) -> FinishedRun:
    """Load a run folder as objects, in the state of a checkpoint.

    The folder says which classes are made, a user's own among them, which are looked for in the
    working folder and where Python looks: load only runs that you trust.  The checkpoint is read as
    plain tensors and values.  Neither Hydra's job nor global state is needed or changed, except
    that the modules of `extensions` are imported; random numbers are left as they were.

    Args:
        folder: of the run.
        checkpoint: `last`, `best`, or the path of a file.
        overrides: as of the command line, applied over the run's own; see `with_overrides`.
            Whether they make another camera is not looked at here: parameters of the lens are those
            of the checkpoint in any case.
        output: where paths of the configuration within the run folder lead to; None: the folder.

    Raises:
        InputError: the folder is none of a run; it has no such checkpoint; a class is not there; or
            the checkpoint is of another experiment, lens or network.
    """
    record = read_record(folder, output)
    register_resolvers()
    with working_folder_importable():
        return _loaded(record, with_overrides(record, overrides), checkpoint)


def _loaded(record: RecordedRun, config: Mapping[str, Any], checkpoint: str | Path) -> FinishedRun:
    import_extensions(config.get("extensions"))
    try:
        refuse_unknown_keys(config, ("module",))
    except InputError as error:
        raise InputError(
            f"{record.folder}: {error}; Python looks for classes in the working folder, "
            f"{Path.cwd()}, and in those of PYTHONPATH"
        ) from None
    cfg = OmegaConf.create(dict(config))
    settings = RunSettings.of(cfg)
    with torch.random.fork_rng(devices=()):
        lens = lens_from_prescription(
            settings.prescription(), settings.dtype, where="lens", backend=settings.backend
        )
        module = _made("module", settings.module)(lens=lens)
    check_experiment(module, train=False)
    file, state = None, {}
    if module.trains:
        file = _checkpoint_file(record, checkpoint)
        state = read_checkpoint(file)
        _take_up(module, state, file)
    elif str(checkpoint) != CHECKPOINTS[0]:
        raise InputError(
            f"{record.folder}: {type(module).__name__} trains nothing, and has no checkpoint"
        )
    module.eval()
    step, epoch = int(state.get("global_step", 0)), int(state.get("epoch", -1)) + 1
    return FinishedRun(record, cfg, settings, module, file, step, epoch)


def _checkpoint_file(record: RecordedRun, checkpoint: str | Path) -> Path:
    """Return the path of a checkpoint.

    Raises:
        InputError: there is none.
    """
    if str(checkpoint) not in CHECKPOINTS:
        file = Path(checkpoint).expanduser().resolve()
        if not file.is_file():
            raise InputError(
                f"checkpoint: {checkpoint} does not exist; allowed: {', '.join(CHECKPOINTS)}, or "
                "the path of a file"
            )
        return file
    folder = record.folder / "checkpoints"
    file = folder / f"{checkpoint}.ckpt"
    if file.is_file():
        return file
    others = sorted(path.stem for path in folder.glob("*.ckpt"))
    there = f"there is {', '.join(others)}" if others else "there is none"
    raise InputError(
        f"{record.folder}: this run ({record.status}) has no checkpoint checkpoints/{file.name}; "
        f"{there}"
    )


def read_checkpoint(file: Path) -> Mapping[str, Any]:
    """Read a checkpoint as plain tensors and values, on the CPU.

    Raises:
        InputError: the file holds something else, or no state of a module.
    """
    try:
        found = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file} is not a safe checkpoint ({reason})") from None
    if not isinstance(found, Mapping) or "state_dict" not in found:
        raise InputError(f"{file} holds no state of a module")
    return found


def _take_up(module: Experiment, state: Mapping[str, Any], file: Path) -> None:
    """Give a module the state of a checkpoint, as a trainer does.

    Raises:
        InputError: the checkpoint is of another experiment, lens or network.
    """
    module.on_load_checkpoint(dict(state))
    try:
        module.load_state_dict(state["state_dict"])
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{file} does not fit the run's configuration: {reason}") from None
    module.settle()


def _made(key: str, config: DictConfig) -> Any:
    """Return what a part of the configuration makes.

    Raises:
        InputError: it cannot be made; one line with the reason.
    """
    try:
        return instantiate(config)
    except HydraException as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise InputError(f"{key}: {' '.join(str(error).split())}") from error


@contextmanager
def working_folder_importable() -> Iterator[None]:
    """Let Python find a user's own modules in the working folder, as `python train.py` does."""
    before, folder = list(sys.path), str(Path.cwd())
    if folder not in sys.path and "" not in sys.path:
        sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path[:] = before
