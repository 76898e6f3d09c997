"""Checkpoints are files that are written whole, read as plain values, and checked for damage."""

import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from dolens.errors import InputError, one_line
from dolens.files import written_whole

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
            raise InputError(f"{where}{path} is damaged: its {key} is {_shown(value)}")
    for name, value in found["state_dict"].items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
            raise InputError(f"{where}{path} is damaged: its {name} is {_shown(value)}")
    return found


def _shown(value: Any) -> str:
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
