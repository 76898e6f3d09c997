"""Lightning's trainer is made, and the processes of one run are started and ended together.

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
from typing import Any

import lightning
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.plugins.layer_sync import LayerSync
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from omegaconf import DictConfig
from torch import nn

from dolens.errors import InputError, check_choice, one_line
from dolens.experiments.experiment import EXACT, MIXED
from dolens.experiments.running.run_files import write_json
from dolens.reconstruction.processes import own_batch_statistics, share_batch_statistics

_STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true")
_PRECISIONS = ("32", "bf16", EXACT, MIXED)


class SharedBatchStatistics(LayerSync):
    """Lets batch normalisations see the batch of all processes, as that of one process."""

    def apply(self, model: nn.Module) -> nn.Module:
        """Replace them."""
        return share_batch_statistics(model)

    def revert(self, model: nn.Module) -> nn.Module:
        """Put those back that were there before."""
        return own_batch_statistics(model)


# What Lightning brings about in every run, and in every run that is resumed in a folder of its own.
_OF_EVERY_RUN = (
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    "The dirpath has changed from",
)


def quiet_lightning() -> None:
    """Let Lightning say nothing but warnings, and none of its own doing.

    The rest is advertisements, and what a run says by itself.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in _OF_EVERY_RUN:
        warnings.filterwarnings("ignore", message)


def made_trainer(
    settings: DictConfig, callbacks: Sequence[lightning.Callback], loggers: Sequence[Any]
) -> lightning.Trainer:
    """Make a trainer.

    Args:
        settings: of `lightning.Trainer`.
        callbacks: of the run.
        loggers: of the run.

    Raises:
        InputError: a strategy, a precision, a number of processes or of accumulated batches that
            cannot be.
    """
    quiet_lightning()
    strategy = settings.get("strategy", "auto")
    if isinstance(strategy, str):
        check_choice(strategy, _STRATEGIES, "trainer.strategy")
    _check_precision(settings.get("precision"))
    batches = settings.get("accumulate_grad_batches", 1)
    if type(batches) is not int or batches < 1:
        raise InputError(f"trainer.accumulate_grad_batches: {batches!r}; allowed: 1 or more")
    # Samples and evaluation batches are shared out by the data themselves.
    own: dict[str, Any] = {"use_distributed_sampler": False}
    if not {"plugins", "sync_batchnorm"} & set(settings):
        own["plugins"] = [SharedBatchStatistics()]
    if rank_zero_only.rank:
        own["enable_progress_bar"] = False
    try:
        return instantiate(settings, callbacks=list(callbacks), logger=list(loggers), **own)
    except InstantiationException as error:
        raise InputError(f"trainer: {one_line(error.__cause__ or error)}") from None


def _check_precision(precision: Any) -> None:
    """Refuse a precision in which optics would be computed, or loss scaling that they know not of.

    Raises:
        InputError: it is neither single precision nor `bf16-mixed`.
    """
    if precision is not None and str(precision) not in _PRECISIONS:
        raise InputError(
            f"trainer.precision: {precision}; allowed: {EXACT}, or {MIXED} for the network alone; "
            "optics are computed in lens_dtype, float32 or float64, whatever this is"
        )


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
