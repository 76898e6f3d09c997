"""Checkpoints are written whole, read as plain values, and compared with the run that resumes."""

import logging
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from dolens.errors import InputError, one_line
from dolens.experiments.experiment import Experiment, refuse_another
from dolens.experiments.running.recorded_run import RecordedRun
from dolens.experiments.running.run_files import flat, present_settings
from dolens.files import resolved_path, written_whole

logger = logging.getLogger(__name__)

SETTINGS = "dolens_settings"
# What a run may change without being another one: what it writes, and which parts of it are done.
_FREE = ("hydra", "callbacks", "logger", "ckpt_path", "train", "test", "objective")
# So many differences are named where a checkpoint is refused.
_NAMED = 4


class SettingsInCheckpoints(lightning.Callback):
    """Writes a run's settings into its checkpoints, as plain values.

    Args:
        settings: name → value, as `settings_of` gives them.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)

    def on_save_checkpoint(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        checkpoint: dict[str, Any],
    ) -> None:
        """Add them."""
        checkpoint[SETTINGS] = dict(self.settings)


def settings_of(cfg: DictConfig) -> dict[str, Any]:
    """The configuration that decides a run's numbers, flat: name → plain value.

    Interpolations stay as they are written, so that a value that many parts refer to is there once,
    and folders of the machine are not there at all.
    """
    kept = OmegaConf.masked_copy(cfg, [key for key in cfg if key not in _FREE])
    return dict(flat(OmegaConf.to_container(kept, resolve=False)))


def checked_checkpoint(
    path: str, module: Experiment, settings: Mapping[str, Any], training: bool
) -> str:
    """The path of a checkpoint that a run can take up; one warning names every other difference.

    Args:
        path: of the file.
        module: that is to be given its state.
        settings: of this run, as `settings_of` gives them.
        training: whether the run goes on training, and not only tests what was trained.

    Raises:
        InputError: the file is missing, damaged, no checkpoint of plain tensors and values, or of
            another experiment, lens, network or (where training goes on) precision of the lens.
    """
    if not Path(path).is_file():
        raise InputError(f"ckpt_path: {path} does not exist")
    checkpoint = read_checkpoint(path, "ckpt_path: ")
    refuse_another(checkpoint.get("dolens"), module.identity())
    written = checkpoint.get(SETTINGS)
    if not isinstance(written, Mapping):
        logger.warning(
            "ckpt_path: %s does not say which settings it was written with (lens, seed, precision, "
            "learning rates, ...); whether this run has the same ones is not known",
            path,
        )
    else:
        _compare(present_settings(written), settings, training)
    most, epoch = settings.get("trainer.max_epochs"), checkpoint.get("epoch", 0)
    if training and isinstance(most, int) and 0 <= most <= epoch:
        raise InputError(
            f"trainer.max_epochs: {most}; the checkpoint is of epoch {epoch + 1}; allowed: "
            f"{epoch + 1}, or more to go on training"
        )
    logger.info("Going on from %s, after %d steps", path, checkpoint.get("global_step", 0))
    reason = misfit(checkpoint["state_dict"], module.state_dict())
    if reason:
        raise InputError(f"ckpt_path: {reason}; resume with the settings that wrote it")
    return path


def _compare(written: Mapping[str, Any], own: Mapping[str, Any], training: bool) -> None:
    names = [*own, *(name for name in written if name not in own)]
    differences = {
        name: f"{name} is {_shown(own, name)}, was {_shown(written, name)}"
        for name in names
        if name not in own or name not in written or own[name] != written[name]
    }
    fixed = [n for n in differences if n.startswith("lens.") or (training and n == "lens_dtype")]
    if fixed:
        more = f" and {len(fixed) - _NAMED} more" if len(fixed) > _NAMED else ""
        raise InputError(
            "ckpt_path: the checkpoint is of another lens, whose state it would put in the place "
            f"of this one: {'; '.join(differences[n] for n in fixed[:_NAMED])}{more}"
        )
    kinds = [n for n in differences if n in ("scheduler", "scheduler._target_")]
    if training and kinds:
        raise InputError(
            f"ckpt_path: {differences[kinds[0]]}; a schedule goes on as one of its kind"
        )
    if differences:
        logger.warning(
            "ckpt_path: this run differs from the one that wrote the checkpoint: %s. Weights and "
            "learning rates that the checkpoint holds go on as they were; schedules are this run's",
            "; ".join(differences.values()),
        )


def _shown(settings: Mapping[str, Any], name: str) -> str:
    return repr(settings[name]) if name in settings else "not set"


CHECKPOINTS = ("last", "best")


def checkpoint_file(record: RecordedRun, checkpoint: str | Path) -> Path:
    """Return the path of a checkpoint.

    Raises:
        InputError: there is none.
    """
    if str(checkpoint) not in CHECKPOINTS:
        file = resolved_path(checkpoint)
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
    if not record.config["train"]:
        tested = record.config.get("ckpt_path")
        there += ": it trained nothing" + (f", and tested {tested}" if tested else "")
    raise InputError(
        f"{record.folder}: this run ({record.status}) has no checkpoint checkpoints/{file.name}; "
        f"{there}"
    )


def take_up(module: Experiment, state: Mapping[str, Any], file: Path) -> None:
    """Give a module the state of a checkpoint, as a trainer does.

    Raises:
        InputError: the checkpoint is of another experiment, lens or network.
    """
    values = state["state_dict"]
    try:
        module.on_load_checkpoint(dict(state))
        reason = misfit(values, module.state_dict())
        if not reason:
            module.load_state_dict(values)
            module.settle()
    except InputError:
        raise
    except Exception as error:  # what an experiment keeps besides may be damaged in many ways
        reason = one_line(f"{type(error).__name__}: {error}")
        raise InputError(f"{file} does not fit the run's configuration: {reason}") from error
    if reason:
        raise InputError(f"{file} does not fit the run's configuration: {reason}")


def misfit(found: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> str:
    """Return the first thing in which a state differs from what a module takes; nothing: ''."""
    for name, value in own.items():
        if name not in found:
            return f"{name} is missing in the checkpoint"
        if found[name].shape != value.shape:
            shapes = tuple(found[name].shape), tuple(value.shape)
            return f"{name} has shape {shapes[0]} in the checkpoint and {shapes[1]} here"
        if found[name].is_complex() != value.is_complex():
            return f"{name} is {found[name].dtype} in the checkpoint and {value.dtype} here"
    return next((f"there is no {name} here" for name in found if name not in own), "")


# So much of a foreign program's reason is repeated.
_REASON = 200
# What a checkpoint may have of Lightning's, and of which kind it is.
_KINDS: Mapping[str, type] = {
    "state_dict": dict,
    "global_step": int,
    "epoch": int,
    "optimizer_states": list,
    "lr_schedulers": list,
    "loops": dict,
    "callbacks": dict,
    "pytorch-lightning_version": str,
}
_GLOBAL = re.compile(r"GLOBAL (\S+)")


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint beside the one before it, and replaces that once the disk has it all.

    Lightning's own writer brings it together in the system's temporary folder, which may be on
    another disk: it is then copied over the checkpoint before it, and what interrupts the copy
    leaves neither.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint.

        Args:
            checkpoint: plain values and tensors.
            path: of the file, or an address of a store that `fsspec` knows.
            storage_options: none are taken.

        Raises:
            OSError: it cannot be written, as on a full disk; the one before it stays.
        """
        if storage_options is not None or "://" in str(path):
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        file = Path(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(file) as aside:
            _save(checkpoint, aside)


def _save(checkpoint: Mapping[str, Any], path: Path) -> None:
    try:
        with path.open("wb") as file:
            torch.save(dict(checkpoint), file)
    except (OSError, RuntimeError) as error:
        # PyTorch's writer reports a place in the file that does not fit, for every reason.
        reason = error if isinstance(error, OSError) else error.__context__
        if isinstance(reason, OSError):
            reason.filename = str(path)
            raise reason from None
        raise


def read_checkpoint(path: str | Path, where: str = "") -> Mapping[str, Any]:
    """Read a checkpoint as plain tensors and values, on the CPU; nothing in it is executed.

    Every part of the file has a checksum (CRC-32), which PyTorch writes and does not look at.

    Args:
        path: of the file.
        where: what messages begin with, such as `ckpt_path: `.

    Raises:
        InputError: the file is damaged, holds something else, or no state of a module.
    """
    try:
        damaged = _damaged_part(path)
        if damaged is None:
            found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        reason = _reason(error)
        raise InputError(f"{where}{path} is not a safe checkpoint ({reason[:_REASON]})") from None
    if damaged is not None:
        raise InputError(
            f"{where}{path} is damaged: the checksum of its part '{damaged}' is not that of its "
            "content; take another checkpoint of the run, or one of a copy"
        )
    if not isinstance(found, Mapping) or "state_dict" not in found:
        raise InputError(f"{where}{path} holds no state of a module")
    for key, kind in _KINDS.items():
        value = found.get(key, kind())
        negative = isinstance(value, int) and (isinstance(value, bool) or value < 0)
        if not isinstance(value, kind) or negative:
            raise InputError(f"{where}{path} is damaged: its {key} is {_type_and_value(value)}")
    for name, value in found["state_dict"].items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
            raise InputError(f"{where}{path} is damaged: its {name} is {_type_and_value(value)}")
    return found


def _type_and_value(value: Any) -> str:
    return one_line(f"{type(value).__name__} {value!r}")[:_REASON]


def _reason(error: Exception) -> str:
    """Return why PyTorch does not read a file, without its advice to execute what is in it."""
    called = _GLOBAL.search(str(error))
    if called is not None:
        return f"it would call {one_line(called[1])}"
    if isinstance(error, pickle.UnpicklingError):
        return "it holds more than plain tensors and values"
    return one_line(str(error).splitlines()[0] if str(error) else type(error).__name__)


def _damaged_part(path: str | Path) -> str | None:
    """Return the first part of a zip file that is not what was written; None: there is none."""
    if not zipfile.is_zipfile(path):
        return None  # of a PyTorch before 1.6, or no checkpoint, which PyTorch says
    with zipfile.ZipFile(path) as file:
        return file.testzip()
