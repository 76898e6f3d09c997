"""One job of a sweep, and its folder as an earlier process may have left it."""

import fcntl
import logging
import math
import os
import shutil
import sys
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from dolens.errors import InputError
from dolens.experiments.running.run_files import (
    CONFIG,
    HYDRA,
    INFO,
    METRICS,
    OVERRIDES,
    RESOLVED,
    flat,
    is_finished,
    metrics_of,
    read_settings,
    read_yaml,
)
from dolens.prescriptions.plain_values import plain_values

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SweepJob:
    """A job of a sweep: its configuration, its folder, and what the program's process knows.

    Attributes:
        number: of the job, from 0; `hydra.job.num`.
        overrides: that tell it from the other jobs.
        config: the composed configuration, with Hydra's own part.
        folder: of the run.
        task: runs the configuration.
        context: Hydra's.
        singletons: Hydra's state, for another process.
        arguments: the command line of the sweep.
        working_folder: where the sweep was started.
    """

    number: int
    overrides: tuple[str, ...]
    config: DictConfig
    folder: Path
    task: TaskFunction
    context: HydraContext
    singletons: dict[Any, Any] = field(default_factory=Singleton.get_state)
    arguments: tuple[str, ...] = field(default_factory=lambda: tuple(sys.argv))
    working_folder: Path = field(default_factory=Path.cwd)

    def text(self) -> str:
        """Return the overrides as a user wrote them, without those of Hydra's own part."""
        return " ".join(entry for entry in self.overrides if not entry.startswith("hydra."))

    def threads(self) -> int | None:
        """Return the number of threads that the user gave to this job; None: none was given."""
        threads = OmegaConf.select(self.config, "threads")
        return threads if isinstance(threads, int) and threads > 0 else None

    def run(self) -> JobReturn:
        """Run the job, or return the objective of its finished run.

        One process at a time works in a run folder; another waits, and then finds the run
        finished.  A run that was killed goes on from its last checkpoint; without one, what it left
        is removed, and it begins anew.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with held(self.folder):
            if is_finished(self.folder):
                return self.finished()
            config = self.config
            own = OmegaConf.select(config, "ckpt_path")  # that all jobs begin with
            checkpoint = last_checkpoint(self.folder) if own is None else None
            if checkpoint is None:
                clear(self.folder)
            else:
                config = config.copy()
                with open_dict(config):
                    config.ckpt_path = str(checkpoint)
                logger.info("Job %d goes on from %s", self.number, checkpoint)
                log_in(self.folder, "INFO", f"The run was stopped, and goes on from {checkpoint}")
            return run_job(
                hydra_context=self.context,
                config=config,
                task_function=self.task,
                job_dir_key="hydra.sweep.dir",
                job_subdir_key="hydra.sweep.subdir",
            )

    def finished(self) -> JobReturn:
        """Return the objective of the finished run in this job's folder."""
        return self._return(recorded_objective(self.folder))

    def failed(self, reason: str) -> JobReturn:
        """Record that the job's process ended without a result; the objective is NaN.

        Args:
            reason: one line for the run's log.txt, and so for the sweep's table.
        """
        if not (self.folder / CONFIG).is_file():
            # The process ended before Hydra wrote anything: a table finds a run by its settings.
            (self.folder / CONFIG).parent.mkdir(parents=True, exist_ok=True)
            hydra = OmegaConf.masked_copy(self.config, ["hydra"])
            OmegaConf.save(hydra.hydra.overrides.task, self.folder / OVERRIDES)
            OmegaConf.save(hydra, self.folder / HYDRA)
            OmegaConf.save(self.settings(), self.folder / CONFIG)
        log_in(self.folder, "ERROR", reason)
        logger.error("Job %d: %s", self.number, reason)
        return self._return(math.nan)

    def settings(self) -> DictConfig:
        """Return the configuration without Hydra's own part."""
        return OmegaConf.masked_copy(self.config, [key for key in self.config if key != "hydra"])

    def _return(self, objective: float | tuple[float, ...]) -> JobReturn:
        return JobReturn(
            overrides=OmegaConf.to_container(self.config.hydra.overrides.task, resolve=False),
            cfg=self.settings(),
            hydra_cfg=OmegaConf.masked_copy(self.config, ["hydra"]),
            working_dir=str(self.working_folder),
            status=JobStatus.COMPLETED,
            _return_value=objective,
        )


@dataclass(frozen=True)
class Elsewhere:
    """Runs a job in a process that is not the program's own.

    Args:
        job: to run.
    """

    job: SweepJob

    def __call__(self) -> JobReturn:
        """Give the process what it needs to know, and run the job."""
        setup_globals()
        Singleton.set_state(self.job.singletons)
        sys.argv = list(self.job.arguments)
        if self.job.working_folder.is_dir():
            os.chdir(self.job.working_folder)
        return self.job.run()

    def checkpoint(self) -> Any:
        """Return what submitit runs in a Slurm job that is queued again: the same once more."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


_LAST = Path("checkpoints", "last.ckpt")
# How a run is made, not what comes of it.
_FREE = ("hydra", "threads")
# What a run writes before its first checkpoint; log.txt stays.
_LEFT = ("checkpoints", "tensorboard", "figures", "lens", INFO, METRICS, "metrics.csv")
# So many differences are named where a folder is refused.
_NAMED = 3


def refuse_other_settings(folder: Path, settings: str) -> None:
    """Refuse a folder that holds a run of other settings.

    Args:
        folder: of a job.
        settings: of the job that is to run there, as YAML, not resolved.

    Raises:
        InputError: a run has begun there with other settings; the message names the differences.
    """
    if not (folder / INFO).is_file():
        return  # no run got so far as to compute anything
    written = read_settings(folder / CONFIG) or {}
    if written.get("ckpt_path") == str(folder / _LAST):
        written["ckpt_path"] = None  # the run was stopped before, and had gone on
    differences = _differences(_plain(written), _plain(plain_values(settings, "the job")))
    if differences:
        more = f" and {len(differences) - _NAMED} more" if len(differences) > _NAMED else ""
        raise InputError(
            f"hydra.sweep.dir: {folder} holds a run of other settings: "
            f"{'; '.join(differences[:_NAMED])}{more}; choose another folder, or remove this one"
        )


def recorded_objective(folder: Path) -> float | tuple[float, ...]:
    """Return the objective of a finished run, or several; NaN where its metrics do not have it."""
    named = (read_yaml(folder / RESOLVED) or {}).get("objective")
    metrics = metrics_of(folder)
    if isinstance(named, list):
        return tuple(metrics.get(str(name), math.nan) for name in named)
    return metrics.get(str(named), math.nan)


def last_checkpoint(folder: Path) -> Path | None:
    """Return the last checkpoint of a run that has not come to its end; None where it has none."""
    path = folder / _LAST
    if not (folder / INFO).is_file() or not path.is_file():
        return None
    if not zipfile.is_zipfile(path):
        logger.warning("%s is no whole checkpoint: the run begins anew", path)
        return None
    return path


def clear(folder: Path) -> None:
    """Remove what a run left that was stopped before its first checkpoint; its log stays."""
    for name in _LEFT:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def log_in(folder: Path, level: str, text: str) -> None:
    """Write a line into the log of a run whose own process does not write there, or not yet.

    Args:
        folder: of the run.
        level: `INFO`, `ERROR` and so on.
        text: of one line.
    """
    time = datetime.now().strftime("%Y-%m-%d %H:%M:%S,%f")[:-3]
    with (folder / "log.txt").open("a", encoding="utf-8") as file:
        file.write(f"[{time}] {level} {__name__}: {text}\n")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let no other process into a run folder; wait where another one is in it.

    A process that ends, however it ends, leaves the folder.  File systems that know no locks let
    everybody in.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            logger.warning("Another process runs this job in %s; waiting for its end", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError as error:
            logger.warning("%s cannot be locked (%s): start no second sweep there", folder, error)
        yield
    finally:
        os.close(handle)


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    return dict(flat({key: value for key, value in settings.items() if key not in _FREE}))


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"{name} is {now.get(name, 'not set')!r}, was {before.get(name, 'not set')!r}"
        for name in {**now, **before}
        if name not in now or name not in before or now[name] != before[name]
    ]
