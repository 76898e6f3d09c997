"""Runs of `dolens train` in processes that are forked, and need not import anything; and how they
ended: in one line, and so that they can go on.
"""

import atexit
import contextlib
import importlib
import io
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from scripts.faults.run_folders import differences

# Of a process that was asked to end.
PATIENCE_S = 120.0
_IMPORTED = (
    *("lightning.pytorch.callbacks", "matplotlib.pyplot", "torch.utils.tensorboard"),
    *("torchmetrics.image", "skimage.io", "torchvision.models"),
    *("numba", "torch._dynamo", "torch._decomp.decompositions_for_jvp"),
    *("dolens.experiments.camera.camera", "dolens.experiments.design.design"),
    *("dolens.experiments.poses.misalignment", "dolens.experiments.poses.triplet_alignment"),
    *("dolens.experiments.tolerances.tolerances", "dolens.experiments.running.main"),
)
_SLICES, _PAUSE_S = 8, 0.01


def warm_up() -> None:
    """Import what every run needs, and start no thread: a forked process has only one."""
    torch.set_num_threads(1)
    for name in _IMPORTED:
        importlib.import_module(name)


@dataclass
class Process:
    """A run in a process of its own.

    Attributes:
        pid: of the process.
        log: what it prints.
        status: of its exit, negative for a signal; None as long as it runs.
    """

    pid: int
    log: Path
    status: int | None = None

    def poll(self) -> int | None:
        """Return the status of its exit; None as long as it runs."""
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if pid else None
        return self.status

    def wait(self, patience_s: float = PATIENCE_S) -> int:
        """Wait for its end, and return its status.

        Raises:
            TimeoutError: it did not end, and was killed.
        """
        end = time.monotonic() + patience_s
        while self.poll() is None:
            if time.monotonic() > end:
                os.kill(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                self.status = -signal.SIGKILL
                raise TimeoutError(f"process {self.pid} did not end")
            time.sleep(0.005)
        return self.status

    def said(self) -> str:
        """Return what it has printed."""
        return self.log.read_text(encoding="utf-8", errors="replace")


def start(
    arguments: Sequence[str], log: Path, prepare: Callable[[], None] | None = None
) -> Process:
    """Start `dolens train` with some arguments.

    Args:
        arguments: as of a command line.
        log: a file for what it prints.
        prepare: called in the new process before the run.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return Process(pid, log)
    status = 1
    try:
        with log.open("wb", buffering=0) as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if prepare is not None:
            prepare()
        from dolens.cli.train import run_training

        run_training(list(arguments), "dolens train")
        status = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def trust() -> None:
    """Leave out the search for settings that nothing reads: the same ones were searched before."""
    from dolens.experiments.running import configuration

    configuration.refuse_unread = lambda *_: None


def write_slowly() -> None:
    """Let checkpoints take their time, so that a process can be killed while one is written."""
    trust()
    save = torch.save

    def slowly(content: object, file: object, **options: object) -> None:
        buffer = io.BytesIO()
        save(content, buffer, **options)
        whole = buffer.getbuffer()
        size = -(-len(whole) // _SLICES)
        for first in range(0, len(whole), size):
            file.write(whole[first : first + size])
            file.flush()
            time.sleep(_PAUSE_S)

    torch.save = slowly


def line_of(process: Process) -> str:
    """Return the line by which a run ended."""
    lines = [line for line in process.said().splitlines() if line.strip()]
    return lines[-1] if lines else ""


def refused(process: Process, *words: str) -> list[str]:
    """Return what is wrong with the way in which a run failed."""
    said, line = process.said(), line_of(process)
    wrong = [] if process.status else ["the run did not fail"]
    if not line.startswith("error: "):
        wrong.append(f"ends in: {line[:200]}")
    if "Traceback" in said:
        wrong.append("prints a traceback")
    return wrong + [f"'{word}' is not in: {line[:300]}" for word in words if word not in line]


def goes_on(folder: Path, overrides: list[str], whole: list[str] | None = None) -> list[str]:
    """Resume a run, and return in what it differs from one that nothing happened to."""
    undisturbed = whole_run(*overrides)
    last = folder / "checkpoints" / "last.ckpt"
    resume = [f"ckpt_path={last}"] if last.exists() else []
    command = [*(whole or overrides), f"hydra.run.dir={folder}", *resume]
    process = start(command, log(folder), trust)
    if process.wait(600.0):
        return [f"the resumed run fails: {line_of(process)}"]
    return differences(undisturbed, folder)


@cache
def whole_run(*overrides: str) -> Path:
    """Return the folder of a run that nothing happens to, which is made once.

    It has no worker processes: its samples are the same.

    Raises:
        RuntimeError: the run fails.
    """
    folder = Path(tempfile.mkdtemp(prefix="whole_run_"))
    atexit.register(shutil.rmtree, folder)
    alone = [entry for entry in overrides if not entry.startswith("data.num_workers")]
    process = start([*alone, f"hydra.run.dir={folder / 'run'}"], folder / "0.log")
    if process.wait(600.0):
        raise RuntimeError(f"the whole run fails: {line_of(process)}")
    return folder / "run"


def log(folder: Path) -> Path:
    """Return a new file for what a process prints."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / f"{len(list(folder.parent.glob('*.log')))}.log"
    path.touch()  # the next one is another, however soon it is asked for
    return path


def await_checkpoint(process: Process, run: Path) -> bool:
    """Wait for the first checkpoint of a run; return whether there is one, and the run goes on."""
    last = run / "checkpoints" / "last.ckpt"
    while process.poll() is None and not last.exists():
        time.sleep(0.003)
    return process.poll() is None
