"""What every thread of a team does: take the next share of the work until none is left."""

from collections.abc import Callable
from functools import cache

from numba import carray, types

from dolens.kernels.cpu.compiler import call_driver, fetch_add, int64_at


class Task:
    """Where a team finds things: places in an array of integers that its threads share."""

    NEXT_WORKER, NEXT_SHARE, SHARES = 0, 1, 2  # two counters, and the number of shares
    DRIVER, BOUNDS, JOBS = 3, 4, 5  # addresses; (first, end) of each share; a job for each worker
    LENGTH = 6


@cache
def team(real: types.Type) -> Callable[..., None]:
    """A thread's part of a task: cores are not equally fast, nor all ours, so none has its own."""

    def kernel(task):  # noqa: ANN001, ANN202
        bounds = carray(int64_at(task[4]), 1 << 40)
        worker = fetch_add(task, 0, 1)
        job = int64_at(carray(int64_at(task[5]), 1 << 40)[worker])
        share = fetch_add(task, 1, 1)
        while share < task[2]:
            call_driver(task[3], job, bounds[2 * share], bounds[2 * share + 1])
            share = fetch_add(task, 1, 1)

    return kernel
