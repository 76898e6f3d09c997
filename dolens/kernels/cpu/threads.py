"""Spreading a driver over threads: as many as torch is set to use, in a pool of this process's own.

Drivers run without Python's lock.  The pool is made when it is first needed and belongs to one
process: a forked worker makes its own.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

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


def spread(prepare: Callable[[], Callable[[int, int], None]], pieces: int, threads: int) -> None:
    """Run all pieces on this many threads, the calling one among them.

    Each takes the next share when it has done one: cores are not equally fast, nor all ours.

    Args:
        prepare: called once in every thread; gives the function that runs pieces `first` to `last`.
        pieces: how many.
        threads: at most.
    """
    threads = min(threads, pieces)
    shares = deque(_shares(pieces, threads))

    def work() -> None:
        run = prepare()
        while shares:
            try:
                share = shares.popleft()
            except IndexError:  # another thread took the last one
                return
            run(*share)

    if threads <= 1:
        work()
        return
    pool = _pools.get((os.getpid(), threads))
    if pool is None:
        pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="dolens")
        _pools[os.getpid(), threads] = pool
    others = [pool.submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # Whatever stops this thread (Ctrl-C), nobody may write to memory that is given back.
        shares.clear()
        _wait([other for other in others if not other.cancel()])
    for other in others:
        if not other.cancelled():
            other.result()


def _shares(pieces: int, threads: int) -> list[tuple[int, int]]:
    """Neighbouring pieces, first and end: large shares first, then smaller, to end together."""
    shares, first = [], 0
    least = max(1, pieces // (16 * max(threads, 1)))
    while first < pieces:
        size = pieces if threads <= 1 else max(least, (pieces - first) // (2 * threads))
        shares.append((first, min(first + size, pieces)))
        first += size
    return shares


def _wait(others: Sequence[Future]) -> None:
    """Wait for the other threads, through any number of interruptions; then be interrupted."""
    try:
        wait(others)
    except KeyboardInterrupt:
        _wait(others)
        raise
