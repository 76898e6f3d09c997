"""Spreading a driver over threads: as many as torch is set to use, in a pool of this process's own.

Drivers run without Python's lock.  The pool is made when it is first needed and belongs to one
process: a forked worker makes its own.
"""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

# Fewer rays than this are traced sooner than another thread is woken.
SMALL = 1 << 14

# Memory that a thread keeps for its next task, bytes at most.
_KEPT = 1 << 23

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}


def thread_count(rays: int, small: int = SMALL) -> int:
    """Threads for this many rays: torch's own setting, and one for fewer than `small`."""
    return 1 if rays < small else max(1, torch.get_num_threads())


_own = threading.local()


def scratch(size: int) -> np.ndarray:
    """Memory of at least this many bytes, of this thread's own, for the task that it runs now.

    Asking the system for fresh pages at every call would cost a tenth of a small trace.
    """
    memory = getattr(_own, "memory", None)
    if memory is None or memory.nbytes < size:
        memory = np.empty(size, dtype=np.uint8)
        if size <= _KEPT:
            _own.memory = memory
    return memory


def spread(task: Callable[[int, int, int], None], pieces: int, threads: int) -> None:
    """Run `task(worker, first, last)` over all pieces, cut evenly among the workers.

    The calling thread is worker 0.
    """
    threads = min(threads, pieces)
    bounds = [pieces * w // threads for w in range(threads + 1)] if threads else [0, 0]
    if threads <= 1:
        task(0, 0, pieces)
        return
    pool = _pools.get((os.getpid(), threads))
    if pool is None:
        pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="dolens")
        _pools[os.getpid(), threads] = pool
    others = [pool.submit(task, w, bounds[w], bounds[w + 1]) for w in range(1, threads)]
    task(0, bounds[0], bounds[1])
    for other in others:
        other.result()
