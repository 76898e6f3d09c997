"""The launchers of dolens's sweeps: Hydra finds launchers in the namespace `hydra_plugins` alone.

Hydra imports this module at the start of any program of its own, so that it imports nothing heavy;
`dolens.experiments.sweeps` has the work.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf


class SweepLauncher(Launcher):
    """A launcher that runs no finished job again, and that outlives a killed job.

    Args:
        options: of what runs the jobs, as in `conf/hydra/launcher`.
    """

    def __init__(self, **options: Any) -> None:
        self.options = {
            name: OmegaConf.to_container(value, resolve=True)
            if OmegaConf.is_config(value)
            else value
            for name, value in options.items()
        }
        self.launched = False

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keep what Hydra tells before a sweep begins."""
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run a batch of jobs; see `dolens.experiments.sweeps.launch.launch`."""
        from dolens.experiments.sweeps.launch import launch

        announce, self.launched = not self.launched, True
        return launch(
            self.runner(),
            self.options,
            self.config,
            self.context,
            self.task,
            job_overrides,
            initial_job_idx,
            announce,
        )

    @abstractmethod
    def runner(self) -> Any:
        """Return what runs the jobs."""


class SerialLauncher(SweepLauncher):
    """Runs jobs one after another in the program's own process."""

    def runner(self) -> Any:
        """Return what runs the jobs."""
        from dolens.experiments.sweeps.launch import one_after_another

        return one_after_another


class JoblibLauncher(SweepLauncher):
    """Runs jobs in processes of this machine."""

    def runner(self) -> Any:
        """Return what runs the jobs."""
        from dolens.experiments.sweeps.launchers import in_processes

        return in_processes


class SlurmLauncher(SweepLauncher):
    """Runs jobs on a Slurm cluster."""

    def runner(self) -> Any:
        """Return what runs the jobs."""
        from dolens.experiments.sweeps.launchers import in_slurm_jobs

        return in_slurm_jobs


class RayLauncher(SweepLauncher):
    """Runs jobs on a Ray cluster."""

    def runner(self) -> Any:
        """Return what runs the jobs."""
        from dolens.experiments.sweeps.launchers import in_ray_tasks

        return in_ray_tasks
