"""Jobs run in processes of this machine, as Slurm's jobs, or as tasks of a Ray cluster."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from hydra.core.utils import JobReturn

from dolens.errors import InputError, check_choice, check_count, one_line
from dolens.experiments.running.process_settings import environment_variables
from dolens.experiments.sweeps.job import Elsewhere, SweepJob
from dolens.experiments.workers import joined_cluster, local_cluster
from dolens.threads import allowed_processors

logger = logging.getLogger(__name__)

# Of OpenMP, and so of torch; and of the libraries behind NumPy and SciPy.
_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Share:
    """A `Share` is what each of the jobs that run at once has of a machine.

    Attributes:
        jobs: at once.
        threads: of each.
    """

    jobs: int
    threads: int

    def environment(self) -> dict[str, str]:
        """Return the environment variables that give a process its threads."""
        return dict.fromkeys(_VARIABLES, str(self.threads))


def given_threads(jobs: Sequence[SweepJob]) -> int | None:
    """Return the most threads that the user gave to a job, by `threads` or `OMP_NUM_THREADS`."""
    numbers = [threads for job in jobs if (threads := job.threads())]
    if numbers:
        return max(numbers)
    variable = os.environ.get(_VARIABLES[0], "")
    return int(variable) if variable.isdecimal() and int(variable) else None


def share_of(jobs: Sequence[SweepJob], n_jobs: int, available: int) -> Share:
    """Share a machine out, so that jobs at once times threads are its cores.

    Args:
        jobs: that are to run.
        n_jobs: at once; -1: as many as there are cores for, -2: one less, and so on.
        available: cores.

    Raises:
        InputError: `n_jobs` is 0 or no whole number.
    """
    if type(n_jobs) is not int or n_jobs == 0:
        raise InputError(
            f"hydra.launcher.n_jobs: {n_jobs!r}; allowed: a number of jobs, or -1 for all cores"
        )
    given = given_threads(jobs)
    fitting = max(1, available // (given or 1))
    at_once = n_jobs if n_jobs > 0 else max(1, fitting + 1 + n_jobs)
    at_once = max(1, min(at_once, len(jobs)))
    share = Share(at_once, given or max(1, available // at_once))
    if share.jobs * share.threads > available:
        logger.warning(
            "%d jobs at once of %d threads are more than the %d cores here: each will be slower. "
            "Leave out threads or hydra.launcher.n_jobs, and the other follows",
            *(share.jobs, share.threads, available),
        )
    logger.info(
        "%d jobs, %d at once, of %d thread%s each",
        *(len(jobs), share.jobs, share.threads, "s" if share.threads > 1 else ""),
    )
    return share


_LOOK_S = 0.5


def in_processes(
    jobs: Sequence[SweepJob], n_jobs: int = -1, max_retries: int = 1
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs at once in processes that share the cores of this machine.

    Each process has an executor of joblib's of its own.  One that is killed, as for want of memory,
    takes no other job with it, and it is known which job it ran: the job is repeated from its last
    checkpoint.

    Args:
        jobs: to run.
        n_jobs: at once; -1: all cores.
        max_retries: so often a job whose process was killed is repeated.

    Raises:
        InputError: joblib is not installed, or `n_jobs` is not allowed.
    """
    try:
        from joblib import cpu_count  # it knows the limits of containers too
        from joblib.externals.loky import ProcessPoolExecutor
        from joblib.externals.loky.process_executor import TerminatedWorkerError
    except ModuleNotFoundError:
        raise InputError(
            "hydra/launcher=joblib: the package 'joblib' is not installed; "
            "pip install 'dolens[sweep]'"
        ) from None
    if not jobs:
        return
    share = share_of(jobs, n_jobs, cpu_count())

    def executor() -> Any:
        return ProcessPoolExecutor(
            1, env=share.environment(), initializer=end_with, initargs=(os.getpid(),)
        )

    waiting = deque((job, 0) for job in jobs)
    idle: list[Any] = [executor() for _ in range(share.jobs)]
    running: dict[Any, tuple[SweepJob, int, Any]] = {}
    try:
        while waiting or running:
            while waiting and idle:
                job, retries = waiting.popleft()
                process = idle.pop()
                logger.info("Job %d: %s", job.number, job.text())
                running[process.submit(Elsewhere(job))] = (job, retries, process)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, retries, process = running.pop(future)
                error = future.exception()
                if isinstance(error, TerminatedWorkerError):
                    process.shutdown(wait=False)
                    process = executor()
                idle.append(process)
                if error is None:
                    yield job, future.result()
                elif isinstance(error, TerminatedWorkerError) and retries < max_retries:
                    logger.warning("The process of job %d was killed: once more", job.number)
                    waiting.appendleft((job, retries + 1))
                else:
                    yield job, job.failed(_reason(error))
    finally:
        for process in [*idle, *(process for *_, process in running.values())]:
            process.shutdown(wait=True, kill_workers=True)


def end_with(parent: int) -> None:
    """Let this process end when the one that started it is gone: its jobs would go on alone.

    Args:
        parent: its process id.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _reason(error: BaseException) -> str:
    """Return why a job has no result, in one line."""
    if "TerminatedWorkerError" in type(error).__name__:
        return "the process of this job was killed (by the system for want of memory, or by a user)"
    return one_line(f"{type(error).__name__}: {error}")


_LOOK_AT_SUBMISSIONS_S = 0.2
_MINUTES = {"slurm": 60, "local": 1440}
_LINES = 2


def in_slurm_jobs(
    jobs: Sequence[SweepJob],
    folder: str,
    cluster: str = "slurm",
    array_parallelism: int = 256,
    max_num_timeout: int = 0,
    timeout_min: int | None = None,
    **parameters: Any,
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs as one array of Slurm's; or on this machine, to try a sweep before it goes there.

    Args:
        jobs: to run.
        folder: of submitit's files, that all nodes see.
        cluster: `slurm`, or `local`: in processes that share the cores of this machine, as many at
            once as there are cores for.
        array_parallelism: so many at once, and no more.
        max_num_timeout: so often a job that ran out of its time is queued again, to go on from its
            last checkpoint.
        timeout_min: minutes until a job is ended; None: 60 on Slurm, 1440 on this machine.
        parameters: submitit's own, as `cpus_per_task`, `gpus_per_node`, `mem_gb`,
            and those that it calls `slurm_…` without that word; those that are null are left out.

    Raises:
        InputError: submitit is not installed, there is no Slurm here, a parameter is unknown, or
            its value is not allowed.
    """
    if not jobs:
        return
    try:
        import submitit
    except ModuleNotFoundError:
        raise InputError(
            "hydra/launcher=submitit_slurm: the package 'submitit' is not installed; "
            "pip install 'dolens[slurm]'"
        ) from None
    common = ("cpus_per_task", "gpus_per_node", "mem_gb", "nodes", "name")
    given = {
        name if name in common else f"slurm_{name}": value
        for name, value in parameters.items()
        if value is not None
    }
    check_choice(cluster, tuple(_MINUTES), "hydra.launcher.cluster")
    minutes = _MINUTES[cluster] if timeout_min is None else timeout_min
    try:
        executor = submitit.AutoExecutor(
            folder, cluster=cluster, slurm_max_num_timeout=max_num_timeout
        )
        executor.update_parameters(
            **given, timeout_min=minutes, slurm_array_parallelism=array_parallelism
        )
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        raise InputError(f"hydra/launcher=submitit_slurm: {one_line(error)}") from None
    if cluster == "local":
        yield from _shared_out(jobs, executor, array_parallelism)
        return
    with executor.batch():
        submitted = [(job, executor.submit(Elsewhere(job))) for job in jobs]
    logger.info("%d jobs of Slurm: %s", len(jobs), ", ".join(one.job_id for _, one in submitted))
    while submitted:
        yield from _ended(submitted)


def _shared_out(
    jobs: Sequence[SweepJob], executor: Any, most: int
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs by an executor of this machine, so that jobs at once times threads are its cores."""
    check_count("hydra.launcher.array_parallelism", most)
    cores = allowed_processors()
    share = share_of(jobs, min(most, max(1, cores // (given_threads(jobs) or 1))), cores)
    waiting = deque(jobs)
    running: list[tuple[SweepJob, Any]] = []
    while waiting or running:
        while waiting and len(running) < share.jobs:
            job = waiting.popleft()
            with environment_variables(share.environment()):
                running.append((job, executor.submit(Elsewhere(job))))
        yield from _ended(running)


def _ended(running: list[tuple[SweepJob, Any]]) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Wait a little, yield the jobs that have ended, and take them out of the list."""
    time.sleep(_LOOK_AT_SUBMISSIONS_S)
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


def in_ray_tasks(
    jobs: Sequence[SweepJob],
    address: str | None = None,
    num_cpus: int | None = None,
    num_gpus: float = 0,
    max_retries: int = 1,
) -> Iterator[tuple[SweepJob, JobReturn]]:
    """Run jobs as tasks of Ray's.

    All nodes must see the folder of the sweep, and have the same packages.

    Args:
        jobs: to run.
        address: of a cluster; `auto`: the one that runs on this machine; None: RAY_ADDRESS, or else
            a cluster of this machine alone that ends with the sweep.
        num_cpus: cores, and so threads, of each job; None: its `threads`, or else the cluster's
            cores shared out among the jobs.
        num_gpus: of each job; several jobs share a GPU where this is a part of 1.
        max_retries: so often a job whose process or node was lost is repeated, from its last
            checkpoint.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if not jobs:
        return
    with _cluster(address) as ray:
        share = num_cpus or given_threads(jobs) or _cores_of_a_job(ray, len(jobs))
        task = ray.remote(num_cpus=share, num_gpus=num_gpus, max_retries=max_retries)(_run)
        logger.info("%d tasks of Ray, of %d core%s each", len(jobs), share, "s"[: share > 1])
        running = {task.remote(Elsewhere(job)): job for job in jobs}
        while running:
            (ended, *_), _ = ray.wait(list(running), num_returns=1)
            job = running.pop(ended)
            try:
                result = ray.get(ended)
            except ray.exceptions.RayError as error:
                last = [line for line in str(error).splitlines() if line.strip()] or [""]
                lost = isinstance(error, ray.exceptions.WorkerCrashedError)
                reason = last[0] if lost else last[-1]
                result = job.failed(one_line(f"{type(error).__name__}: {reason}"))
            yield job, result


def _run(job: Elsewhere) -> JobReturn:
    return job()


def _cluster(address: str | None) -> AbstractContextManager[ModuleType]:
    address = address or os.environ.get("RAY_ADDRESS")
    if address is None or address == "local":
        return local_cluster("hydra/launcher=ray")
    return joined_cluster(f"hydra.launcher.address={address}", address)


def _cores_of_a_job(ray: ModuleType, jobs: int) -> int:
    """Return the cores of the cluster for each job, no more than one node has."""
    nodes = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    return max(1, min(sum(nodes) // jobs, max(nodes, default=1)))
