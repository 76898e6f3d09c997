"""The state of a checkpoint is found, and given to a module."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from dolens.errors import InputError, one_line
from dolens.experiments.experiment import Experiment
from dolens.experiments.running.recorded_run import RecordedRun
from dolens.files import resolved_path

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
