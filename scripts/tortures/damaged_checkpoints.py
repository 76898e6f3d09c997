"""Checkpoints that something has happened to."""

import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import torch

from scripts.tortures.disks import RUN
from scripts.tortures.ends import log, refused, whole_run
from scripts.tortures.processes import start, trust


def damaged_checkpoint(folder: Path, damage: Callable[[bytes], bytes], said: str) -> list[str]:
    """Resume from a checkpoint that something has happened to."""
    run = folder / "run"
    shutil.copytree(whole_run(*RUN, "trainer.max_epochs=1"), run)
    last = run / "checkpoints" / "last.ckpt"
    last.write_bytes(damage(last.read_bytes()))
    kept = last.read_bytes()
    process = start(
        [*RUN, f"hydra.run.dir={folder / 'again'}", f"ckpt_path={last}"], log(run), trust
    )
    process.wait()
    wrong = refused(process, "last.ckpt", said)
    return wrong if last.read_bytes() == kept else [*wrong, "the file is another one"]


def flipped(content: bytes) -> bytes:
    """Flip a bit of a weight."""
    place = len(content) // 3
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def cut(content: bytes) -> bytes:
    """Take away the end."""
    return content[: int(0.7 * len(content))]


class Code:
    """Runs code where it is unpickled without care."""

    def __reduce__(self) -> tuple:
        return os.system, ("touch /tmp/dolens_torture_was_executed",)


def with_code(content: bytes) -> bytes:
    """Replace a checkpoint by one that runs code."""
    buffer = io.BytesIO()
    torch.save({"state_dict": {}, "dolens": Code()}, buffer)
    return buffer.getvalue()
