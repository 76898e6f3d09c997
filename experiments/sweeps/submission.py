"""Jobs of Slurm's, or processes in the way of Slurm's jobs, by submitit."""

import logging
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.utils import JobReturn

from dolens.errors import InputError, one_line
from dolens.experiments.environment_variables import environment_variables
from dolens.experiments.sweeps.job import Elsewhere, SweepJob
from dolens.experiments.sweeps.shares import share_of
from dolens.threads import allowed_processors

logger = logging.getLogger(__name__)

_LOOK_S = 0.2
_LINES = 2


def in_local_submissions(
    jobs: Sequence[SweepJob], folder: str, n_jobs: int = -1, timeout_min: int = 1440
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs on this machine as Slurm would: to try a sweep before it goes there.

    Args:
        jobs: to run.
        folder: of submitit's files; `%j` in it stands for the number of a submission.
        n_jobs: at once; -1: all cores.
        timeout_min: minutes until a job is ended.

    Raises:
        InputError: submitit is not installed, or an option is not allowed.
    """
    if not jobs:
        return
    executor = _executor("local", folder, {"timeout_min": timeout_min})
    share = share_of(jobs, n_jobs, allowed_processors())
    waiting = deque(jobs)
    running: list[tuple[SweepJob, Any]] = []
    while waiting or running:
        while waiting and len(running) < share.jobs:
            job = waiting.popleft()
            with environment_variables(share.environment()):
                running.append((job, executor.submit(Elsewhere(job))))
        yield from _ended(running)


def in_slurm_jobs(
    jobs: Sequence[SweepJob],
    folder: str,
    array_parallelism: int = 256,
    max_num_timeout: int = 0,
    **parameters: Any,
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs as one array of Slurm's.

    Args:
        jobs: to run.
        folder: of submitit's files, that all nodes see.
        array_parallelism: so many at once.
        max_num_timeout: so often a job that ran out of its time is queued again, to go on from its
            last checkpoint.
        parameters: submitit's own, as `timeout_min`, `cpus_per_task`, `gpus_per_node`, `mem_gb`,
            and those that it calls `slurm_…` without that word; those that are null are left out.

    Raises:
        InputError: submitit is not installed, there is no Slurm here, or a parameter is unknown.
    """
    if not jobs:
        return
    given = {name: value for name, value in parameters.items() if value is not None}
    common = ("timeout_min", "cpus_per_task", "gpus_per_node", "mem_gb", "nodes", "name")
    executor = _executor(
        "slurm",
        folder,
        {
            **{name if name in common else f"slurm_{name}": v for name, v in given.items()},
            "slurm_array_parallelism": array_parallelism,
        },
        slurm_max_num_timeout=max_num_timeout,
    )
    with executor.batch():
        submitted = [(job, executor.submit(Elsewhere(job))) for job in jobs]
    logger.info("%d jobs of Slurm: %s", len(jobs), ", ".join(one.job_id for _, one in submitted))
    while submitted:
        yield from _ended(submitted)


def _executor(cluster: str, folder: str, parameters: Mapping[str, Any], **options: Any) -> Any:
    launcher = f"hydra/launcher=submitit_{cluster}"
    try:
        import submitit
    except ModuleNotFoundError:
        raise InputError(
            f"{launcher}: the package 'submitit' is not installed; pip install 'dolens[slurm]'"
        ) from None
    try:
        executor = submitit.AutoExecutor(folder, cluster=cluster, **options)
        executor.update_parameters(**parameters)
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        raise InputError(f"{launcher}: {one_line(error)}") from None
    return executor


def _ended(running: list[tuple[SweepJob, Any]]) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Wait a little, yield the jobs that have ended, and take them out of the list."""
    time.sleep(_LOOK_S)
    for entry in [entry for entry in running if entry[1].done()]:
        running.remove(entry)
        job, submission = entry
        try:
            result = submission.results()[0]
        except Exception as error:
            # submitit adds the whole of a job's standard error below the first lines.
            lines = [line for line in str(error).splitlines() if line.strip()]
            reason = " ".join(lines[:_LINES])
            result = job.failed(one_line(f"{type(error).__name__}: {reason}"))
        yield job, result
