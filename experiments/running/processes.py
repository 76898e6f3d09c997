"""The processes of one run: they are started, followed, and ended together.

The first process starts the others with its own arguments.  It alone writes: theirs is a folder of
the system's temporary ones, which goes with them.  Where others start all processes, as torchrun
and Slurm do, nothing is started here.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import write_json

logger = logging.getLogger(__name__)

# Where a process works, and says how it failed, for the first one to report.
_REPORTS = "DOLENS_PROCESS_REPORTS"
# Seconds that a process is given to end by itself.
_GRACE_S = 10.0
_LOOK_S = 0.2
# Words of errors of a process that has lost another.
_OF_LOSS = ("closed by peer", "reset by peer", "broken pipe", "gloo", "nccl", "timed out")


@contextmanager
def own_arguments(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Give the arguments of this process: all but the first write where nobody looks, and are mute.

    Args:
        arguments: of the command, as Hydra takes them.
    """
    if not rank_zero_only.rank:
        yield list(arguments)
        return
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    # In the first process's folder, which goes with it, where it has started this one.
    parent = os.environ.get(_REPORTS)
    with tempfile.TemporaryDirectory(prefix="dolens-process-", dir=parent) as folder:
        yield [*arguments, f"hydra.run.dir={folder}", "hydra.output_subdir=null"]


def report_failure(error: BaseException) -> bool:
    """Tell the first process how this one has failed; return whether there is one to be told."""
    folder = os.environ.get(_REPORTS)
    if folder is None or not rank_zero_only.rank:
        return False
    mistake = isinstance(error, InputError)
    report = {
        "line": one_line(error) if mistake else _named(error),
        "lost": _has_lost_another(error),
        "trace": "" if mistake else "".join(traceback.format_exception(error)),
    }
    write_json(Path(folder) / f"{rank_zero_only.rank}.json", report)
    return True


@contextmanager
def all_processes(trainer: lightning.Trainer, threads: int | None) -> Iterator[None]:
    """Start the other processes that a trainer needs, and end them with this one.

    Args:
        trainer: before its first work.
        threads: torch's threads of each process; None shares out the machine's.

    Raises:
        InputError: another process failed; the line says how.
    """
    if trainer.world_size == 1:
        yield
        return
    with warnings.catch_warnings():
        # What is logged is the same in all processes: it is gathered before.
        warnings.filterwarnings("ignore", message=".*sync_dist=True.*")
        if trainer.strategy.cluster_environment.creates_processes_externally:
            yield
            return
        with _started(trainer, threads):
            yield


@contextmanager
def _started(trainer: lightning.Trainer, threads: int | None) -> Iterator[None]:
    """Start the other processes, and end them with this one."""
    environment = trainer.strategy.cluster_environment
    if trainer.num_nodes > 1:
        raise InputError(
            f"trainer.num_nodes: {trainer.num_nodes} needs torchrun or srun, which start the "
            "processes of all nodes"
        )
    count = trainer.world_size
    added = {
        "MASTER_ADDR": environment.main_address,
        "MASTER_PORT": str(environment.main_port),
        "NODE_RANK": "0",
        "WORLD_SIZE": str(count),
    }
    if threads or "OMP_NUM_THREADS" not in os.environ:
        share = threads or max(1, torch.get_num_threads() // count)
        torch.set_num_threads(share)
        added["OMP_NUM_THREADS"] = str(share)
    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="dolens-reports-") as folder:
        added[_REPORTS] = folder
        os.environ.update(added, LOCAL_RANK="0")
        command = [sys.executable, "-m", "dolens", "train", *sys.argv[1:]]
        started = [
            subprocess.Popen(command, env={**os.environ, "LOCAL_RANK": str(rank)})
            for rank in range(1, count)
        ]
        group = _Started(started, Path(folder))
        watch = threading.Thread(target=group.watch, daemon=True)
        watch.start()
        try:
            yield
            group.wait()
        except (KeyboardInterrupt, SystemExit, InputError):
            raise
        except Exception as error:
            if not _has_lost_another(error):
                raise
            raise InputError(group.reason() or one_line(error)) from error
        finally:
            group.end()
            watch.join()
            os.environ.clear()
            os.environ.update(before)


@dataclass
class _Started:
    """Processes that this one has started.

    Attributes:
        processes: numbers 1, 2, … of the run.
        folder: of their reports.
        over: whether the first process is done with them.
    """

    processes: list[subprocess.Popen]
    folder: Path
    over: bool = False

    def failed(self) -> list[int]:
        """Return the numbers of processes that have ended by a fault."""
        return [n for n, p in enumerate(self.processes, 1) if p.poll() not in (None, 0)]

    def reason(self) -> str | None:
        """Return why a process failed that has not only lost another; None if none did."""
        ends = time.monotonic() + _GRACE_S
        while not self.failed() and time.monotonic() < ends:
            time.sleep(_LOOK_S)
        count = len(self.processes) + 1
        for number in self.failed():
            path = self.folder / f"{number}.json"
            if path.is_file():
                report = json.loads(path.read_text(encoding="utf-8"))
                if not report["lost"]:
                    if report["trace"]:
                        logger.error("process %d: %s", number, report["trace"])
                    return f"process {number} of {count} (from 0) failed: {report['line']}"
                continue
            code = self.processes[number - 1].returncode
            how = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
            return f"process {number} of {count} (from 0) was ended {how}"
        return None

    def watch(self) -> None:
        """End this process where another failed and this one does not notice.

        It may wait for the other in a collective operation that knows no lost processes; then no
        exception can reach it.
        """
        while not self.over and not self.failed():
            time.sleep(_LOOK_S)
        ends = time.monotonic() + _GRACE_S
        while not self.over and time.monotonic() < ends:
            time.sleep(_LOOK_S)
        if not self.over:
            reason = self.reason() or "another process has ended"
            self.end()
            logger.error("%s", reason)
            sys.stderr.write(f"error: {reason}\n")
            os._exit(1)

    def wait(self) -> None:
        """Wait until all have ended, as this one has."""
        for process in self.processes:
            process.wait()

    def end(self) -> None:
        """End those that still run."""
        self.over = True
        for process in self.processes:
            if process.poll() is None:
                process.terminate()
        ends = time.monotonic() + _GRACE_S
        for process in self.processes:
            try:
                process.wait(max(0.0, ends - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _has_lost_another(error: BaseException) -> bool:
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(word in text for word in _OF_LOSS)


def _named(error: BaseException) -> str:
    return one_line(f"{type(error).__name__}: {error}")
