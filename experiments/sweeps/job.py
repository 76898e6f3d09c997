"""One job of a sweep, as it goes to the process that runs it."""

import logging
import math
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from dolens.experiments.running.run_files import CONFIG, HYDRA, OVERRIDES, is_finished
from dolens.experiments.sweeps.job_folder import (
    clear,
    held,
    last_checkpoint,
    log_in,
    recorded_objective,
)
from dolens.threads import follow_other_work

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
        follow_other_work()
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
