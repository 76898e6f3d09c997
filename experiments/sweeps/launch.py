"""A batch of jobs, whatever runs them: what is done already, what fails, and how to go on."""

import inspect
import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus, configure_log, setup_globals
from hydra.experimental.callback import Callback
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from dolens.errors import InputError, one_line
from dolens.experiments.running.command_line import command
from dolens.experiments.running.run_files import is_finished
from dolens.experiments.sweeps.job import SweepJob, refuse_other_settings

logger = logging.getLogger(__name__)

# Runs jobs, and yields each with what it returned when it has ended.
Runner = Callable[..., Iterator[tuple[SweepJob, JobReturn]]]


def launch(
    runner: Runner,
    options: Mapping[str, Any],
    config: DictConfig,
    context: HydraContext,
    task: TaskFunction,
    overrides: Sequence[Sequence[str]],
    first: int,
    announce: bool = True,
) -> list[JobReturn]:
    """Run jobs that have not been run before in their folders.

    Args:
        runner: runs them.
        options: of the runner, as `hydra.launcher` has them.
        config: of the sweep.
        context: Hydra's.
        task: runs the configuration of a job.
        overrides: of each job.
        first: the number of the first job.
        announce: whether to say how a sweep that is stopped goes on.

    Raises:
        InputError: an option is unknown, or a job's folder holds a run of other settings; then no
            job is run.
    """
    setup_globals()
    configure_log(config.hydra.hydra_logging, config.hydra.verbose)
    try:
        inspect.signature(runner).bind((), **options)
    except TypeError as error:
        raise InputError(f"hydra.launcher: {error}") from None
    jobs = [
        composed_job(config, context, task, own, number)
        for number, own in enumerate(overrides, first)
    ]
    for job in jobs:
        refuse_other_settings(job.folder, OmegaConf.to_yaml(job.settings()))
    done = [job for job in jobs if is_finished(job.folder)]
    returns = {job.number: job.finished() for job in done}
    if done:
        logger.info(
            "%d of %d jobs were finished before and are not run again: %s",
            *(len(done), len(jobs), ", ".join(str(job.number) for job in done)),
        )
    to_run = [job for job in jobs if job.number not in returns]
    if announce:
        logger.info("If this sweep is stopped, this goes on with it: %s", command_to_go_on(config))
    for number, (job, result) in enumerate(runner(to_run, **options), 1):
        # A job that ran in this process has changed where lines go.
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        if result.status == JobStatus.FAILED:
            error = result._return_value
            result = job.failed(one_line(f"{type(error).__name__}: {error}"))
        returns[job.number] = result
        logger.info(
            "Job %d has ended (%d of %d): %s", job.number, number, len(to_run), result.return_value
        )
    return [returns[job.number] for job in jobs]


def composed_job(
    config: DictConfig,
    context: HydraContext,
    task: TaskFunction,
    overrides: Sequence[str],
    number: int,
) -> SweepJob:
    """Compose the configuration of a job, and find its folder."""
    own = context.config_loader.load_sweep_config(config, list(overrides))
    with open_dict(own):
        own.hydra.job.num = number
        own.hydra.job.id = f"{own.hydra.job.name}_{number}"
    before = HydraConfig.instance().cfg
    HydraConfig.instance().cfg = own
    try:
        # The time of the sweep's beginning must not be read anew in another process.
        places = {key: str(own.hydra.sweep[key]) for key in ("dir", "subdir")}
    finally:
        HydraConfig.instance().cfg = before
    with read_write(own.hydra.sweep):
        own.hydra.sweep.update(places)
    folder = Path(places["dir"], places["subdir"]).absolute()
    return SweepJob(number, tuple(overrides), own, folder, task, context)


def command_to_go_on(config: DictConfig) -> str:
    """Return the command that goes on with a sweep: the same one, with its folder.

    Args:
        config: of the sweep.
    """
    arguments = sys.argv[1:]
    given = [entry for entry in arguments if entry.startswith("hydra.sweep.dir=")]
    if not given:
        # Jobs of several experiments have folders of their own: what names them stays as it is.
        place = OmegaConf.to_container(config.hydra.sweep, resolve=False)["dir"]
        resolved = str(config.hydra.sweep.dir)
        if "experiment,several" in place and Path(resolved).parent.parent.name == "several":
            resolved = re.sub(r"\$\{now:[^}]*\}", Path(resolved).name[:19], place)
        arguments.append(f"hydra.sweep.dir={resolved}")
    return command(arguments)


def one_after_another(jobs: Sequence[SweepJob]) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs in this process."""
    for job in jobs:
        logger.info("Job %d: %s", job.number, job.text())
        yield job, job.run()


_BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_OWN = "hydra_plugins.dolens_launchers.SerialLauncher"


class OwnBasicLauncher(Callback):
    """Puts dolens's launcher in the place of Hydra's basic one, before a sweep begins.

    A file of the configuration cannot do so: Hydra keeps the name `basic` for its own, and another
    default would win over the launcher that a file of `search` chooses.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Replace the launcher.

        Args:
            config: of the sweep.
            kwargs: what else Hydra tells.
        """
        if config.hydra.launcher.get("_target_") == _BASIC:
            with read_write(config.hydra.launcher):
                config.hydra.launcher._target_ = _OWN
