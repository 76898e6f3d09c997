"""Runs of `dolens train` in processes that need not import anything: they are forked."""

import contextlib
import importlib
import io
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

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
