"""How many jobs run at once on a machine, and how many threads each has."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass

from dolens.errors import InputError
from dolens.experiments.sweeps.job import SweepJob

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
