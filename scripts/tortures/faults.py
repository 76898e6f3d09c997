"""What a run needs is taken away or damaged: one clear line, and the last good state intact."""

import shutil
from collections.abc import Callable
from pathlib import Path

from scripts.tortures.damaged_checkpoints import cut, damaged_checkpoint, flipped, with_code
from scripts.tortures.disks import file_for_folder, full_disk, odd_names, read_only_disk
from scripts.tortures.kernel_caches import compiled_at_once, damaged_kernels
from scripts.tortures.ray_processes import run_and_workers_killed, worker_killed
from scripts.tortures.trainings import (
    failing_figure,
    failing_tensorboard,
    lost_worker,
    nan_in_loss,
    two_at_once,
    unreadable_photograph,
)

Fault = Callable[[Path], list[str]]

_SHARES = (0.0, 0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 0.95)
FAULTS: dict[str, Fault] = {
    **{f"disk full at {s:.0%}": lambda f, s=s: full_disk(f, s) for s in _SHARES},
    "disk read-only": read_only_disk,
    "run folder is a file": lambda f: file_for_folder(f, ""),
    **{
        f"{name} is a file": lambda f, name=name: file_for_folder(f, name)
        for name in ("checkpoints", "lens", ".hydra", "tensorboard", "figures")
    },
    "a folder with odd names": odd_names,
    "two runs in one second": two_at_once,
    "checkpoint: one bit": lambda f: damaged_checkpoint(f, flipped, "checksum"),
    "checkpoint: cut": lambda f: damaged_checkpoint(f, cut, "not a safe checkpoint"),
    "checkpoint: empty": lambda f: damaged_checkpoint(f, lambda _: b"", "not a safe checkpoint"),
    "checkpoint: code": lambda f: damaged_checkpoint(f, with_code, "not a safe checkpoint"),
    "two first compilations at once": compiled_at_once,
    "compiled kernels: a byte and a cut": damaged_kernels,
    "NaN in a loss": nan_in_loss,
    "a worker is killed": lost_worker,
    "a photograph turns unreadable": unreadable_photograph,
    "a worker of Ray is killed": worker_killed,
    "a run with workers of Ray is killed": run_and_workers_killed,
    "figures fail": failing_figure,
    "TensorBoard fails": failing_tensorboard,
}


def done(name: str, folder: Path) -> list[str]:
    """Do one fault, and return what fell."""
    shutil.rmtree(folder, ignore_errors=True)
    try:
        return FAULTS[name](folder)
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
