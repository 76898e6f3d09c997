"""Threads wait without sleeping, unless other work needs the processors that this takes.

PyTorch's threads belong to OpenMP.  Between two operations they look some milliseconds long whether
there is more to do (they spin), which saves a fifth of a short step.  Where other programs want the
same processors, the thread that is waited for may be one that cannot run, and a step takes a
multiple of its time.

GNU's OpenMP spins next to nothing while a process has more of its threads than there are
processors, and asks for that at every wait.  So a process that waits for processors is given some
threads more, which sleep, until the processors are its own again.  Nothing that computes changes.
"""

import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

from dolens.processors import ThreadClock, ThreadTimes, processors

# Without more threads than processors GNU's OpenMP spins so often (its default), and with them not
# at all; others' threads sleep at once.
POLICY = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "300000"}

_LAP_S = 0.5


class Clock(Protocol):
    """Tells how long threads ran and waited since they were asked about last."""

    def lap(self) -> ThreadTimes | None:
        """Return the times."""


class SleepingTeam:
    """Threads of OpenMP's that sleep until they are ended."""

    def __init__(self, openmp: ctypes.CDLL, threads: int) -> None:
        self._over = threading.Event()
        self._openmp, self._threads = openmp, threads
        self._thread = threading.Thread(target=self._hold, daemon=True, name="dolens idle team")
        self._thread.start()

    def _hold(self) -> None:
        # A team belongs to the thread that has first called for it, and ends with it.  What it runs
        # here takes no argument and writes nothing.
        nothing = ctypes.cast(self._openmp.omp_get_thread_num, ctypes.c_void_p)
        self._openmp.GOMP_parallel(nothing, None, self._threads, 0)
        self._over.wait()

    def end(self) -> None:
        """Let the threads end."""
        self._over.set()
        self._thread.join()
