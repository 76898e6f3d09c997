"""Jobs in processes of one machine, by joblib."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from typing import Any

from hydra.core.utils import JobReturn

from dolens.errors import InputError, one_line
from dolens.experiments.sweeps.job import Elsewhere, SweepJob
from dolens.experiments.sweeps.shares import share_of

logger = logging.getLogger(__name__)

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
