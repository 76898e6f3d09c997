"""A driver is spread over as many threads as torch is set to use, and where possible over torch's
own.

Torch's threads belong to OpenMP.  After each of its operations they wait for the next one without
sleeping, for some milliseconds; threads of ours would have to share the cores with them.  So ours
are OpenMP's too, where torch's OpenMP can be found.  They do not survive a fork: a forked process,
and one without that OpenMP, has a pool of threads of its own.

Drivers run without Python's lock.
"""

import ctypes
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numba import carray, types

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.compiler import call_driver, fetch_add, int64_at
from dolens.kernels.cpu.layout import UNBOUNDED

logger = logging.getLogger(__name__)


@cache
def torchs_openmp() -> ctypes.CDLL | None:
    """Return the OpenMP that torch runs on; None where it cannot be found, or has not gcc's
    interface.

    Torch loads its libraries for all to see, and the OpenMP that obeys its setting is its own.
    """
    try:
        symbols = ctypes.CDLL(None)
        symbols.omp_get_max_threads.restype = ctypes.c_int
        symbols.GOMP_parallel.restype = None
        symbols.GOMP_parallel.argtypes = (
            ctypes.c_void_p,
            ctypes.c_void_p,
            ctypes.c_uint,
            ctypes.c_uint,
        )
        # Torch first: in a thread that is new to it, it sets OpenMP's number when it is asked.
        if torch.get_num_threads() == symbols.omp_get_max_threads():
            return symbols
        reason = "another OpenMP is in the way"
    except (AttributeError, OSError, TypeError) as error:
        reason = str(error)
    logger.info("kernels have threads of their own: torch's OpenMP not found (%s)", reason)
    return None


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


# Fewer rays than this are traced sooner than another thread is woken.
SMALL = 1 << 14

# Memory that a thread keeps for its next task, bytes at most; and a line of the cache.
_KEPT = 1 << 23
_LINE = 64

# Runs a task on a number of threads, the calling one among them.
Runner = Callable[[np.ndarray, int], None]

_home = os.getpid()
_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}
_own = threading.local()


def thread_count(rays: int, small: int = SMALL) -> int:
    """Return the threads for this many rays: torch's own setting, or one below `small`."""
    return 1 if rays < small else max(1, torch.get_num_threads())


class Memory(NamedTuple):
    """Memory of a worker.

    Attributes:
        size: bytes from `address` on.
        address: of a line of the cache.
        held: it, as integers of 8 bytes.
    """

    size: int
    address: int
    held: np.ndarray


def scratch(size: int, worker: int) -> Memory:
    """Return memory of at least this many bytes for a worker of the task that the calling thread
    runs.

    Asking the system for fresh pages at every call would cost a tenth of a small trace.
    """
    kept = _own.__dict__.setdefault("memory", {})
    memory = kept.get(worker)
    if memory is None or memory.size < size:
        length, line = -(-size // 8), _LINE // 8
        held = np.empty(length + line, dtype=np.int64)
        held = held[-held.ctypes.data % _LINE // 8 :][:length]
        memory = Memory(size, held.ctypes.data, held)
        if size <= _KEPT:
            kept[worker] = memory
    return memory


def spread(driver: int, jobs: Sequence[int], pieces: int) -> None:
    """Run all pieces on as many threads as there are jobs.

    Args:
        driver: address of a C function of (job, first, end) that runs these pieces; it keeps
            whatever it writes for itself in its job.
        jobs: addresses of arrays of int64, one for each thread.
        pieces: how many.
    """
    threads = min(len(jobs), pieces)
    if threads == 1:
        function_at(driver)(jobs[0], 0, pieces)
        return
    bounds = _shares(pieces, threads)
    addresses = np.array(jobs, dtype=np.int64)
    task = np.zeros(TASK, dtype=np.int64)
    task[SHARES], task[DRIVER] = len(bounds), driver
    task[BOUNDS], task[JOBS] = bounds.ctypes.data, addresses.ctypes.data
    if (openmp := torchs_openmp()) is not None and not is_forked():
        run_with_openmp(openmp, task, threads)
    else:
        run_in_pool(task, threads)


@lru_cache(maxsize=256)
def function_at(driver: int) -> Callable[[int, int, int], None]:
    """Return the driver at an address as a function of the job's address, first and end."""
    return ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)(driver)


def run_alone(task: np.ndarray) -> None:
    """Run a task in the calling thread."""
    compiler.compile_team(team)(_integers(task))


def run_with_openmp(openmp: ctypes.CDLL, task: np.ndarray, threads: int) -> None:
    """Run a task on a team of OpenMP's."""
    function = ctypes.cast(compiler.compile_team(team), ctypes.c_void_p)
    openmp.GOMP_parallel(function, ctypes.c_void_p(task.ctypes.data), threads, 0)


def run_in_pool(task: np.ndarray, threads: int) -> None:
    """Run a task in a pool that belongs to this process."""
    pool = _pools.get((os.getpid(), threads))
    if pool is None:
        pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="dolens")
        _pools[os.getpid(), threads] = pool
    others = [pool.submit(run_alone, task) for _ in range(threads - 1)]
    try:
        run_alone(task)
    finally:
        # Whatever stops this thread (Ctrl-C), nobody may write to memory that is given back.
        task[SHARES] = 0
        _wait([other for other in others if not other.cancel()])


def is_forked() -> bool:
    """Return whether this process may be a fork of one that had OpenMP's threads."""
    return os.getpid() != _home or multiprocessing.parent_process() is not None


def _integers(array: np.ndarray) -> "ctypes._Pointer":
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_int64))


@lru_cache(maxsize=256)
def _shares(pieces: int, threads: int) -> np.ndarray:
    """Return first and end of neighbouring pieces, (S, 2): large shares first, to end together."""
    shares, first = [], 0
    least = max(1, pieces // (16 * threads))
    while first < pieces:
        size = max(least, (pieces - first) // (2 * threads))
        shares.append((first, min(first + size, pieces)))
        first += size
    return np.array(shares, dtype=np.int64).reshape(-1, 2)


def _wait(others: Sequence[Future]) -> None:
    """Wait for the other threads, through any number of interruptions; then be interrupted."""
    try:
        wait(others)
    except KeyboardInterrupt:
        _wait(others)
        raise
