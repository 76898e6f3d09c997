"""Every thread of a team takes the next share of the work until none is left."""

from collections.abc import Callable
from functools import cache

from numba import carray, types

from dolens.kernels.cpu.compiler import call_driver, fetch_add, int64_at
from dolens.kernels.cpu.layout import UNBOUNDED

# Where a team finds things: places in an array of integers that its threads share.  Two counters,
# and the number of shares;
NEXT_WORKER, NEXT_SHARE, SHARES = range(3)
# addresses: the driver, (first, end) of each share, and a job for each worker.
DRIVER, BOUNDS, JOBS = range(3, 6)
TASK = 6  # length


@cache
def team(real: types.Type) -> Callable[..., None]:
    """Compile a thread's part of a task: cores are not equally fast, nor all ours, so none has its
    own.
    """

    def kernel(task):  # noqa: ANN001, ANN202
        bounds = carray(int64_at(task[BOUNDS]), UNBOUNDED)
        worker = fetch_add(task, NEXT_WORKER, 1)
        job = int64_at(carray(int64_at(task[JOBS]), UNBOUNDED)[worker])
        share = fetch_add(task, NEXT_SHARE, 1)
        while share < task[SHARES]:
            call_driver(task[DRIVER], job, bounds[2 * share], bounds[2 * share + 1])
            share = fetch_add(task, NEXT_SHARE, 1)

    return kernel
