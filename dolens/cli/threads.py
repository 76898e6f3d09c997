"""How the threads of a command wait for each other, and how many there are.

Only the program `dolens` sets this, in its own environment and before PyTorch starts; a program of
a user's that imports dolens keeps what it has.
"""

import os
import sys

from dolens.processors import allowed_processors, processors

# Threads of OpenMP wait for some milliseconds without sleeping; on a processor that other work
# needs too, the thread that is waited for may be the one that cannot run.  GNU's OpenMP, which
# PyTorch brings on Linux, then looks a thousand times (some 20 µs), others sleep at once
# (scripts/waiting.py measures it).
_WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}
_OF_USERS = (*_WAITING, "KMP_BLOCKTIME", "KMP_LIBRARY")
COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")


def let_threads_sleep() -> None:
    """Have threads that wait leave their processor to others; a user's own choice stays."""
    if "torch" not in sys.modules and not any(name in os.environ for name in _OF_USERS):
        os.environ.update(_WAITING)


def limit_threads() -> None:
    """Have no more threads than a quota allows; a user's own number stays.

    Experiments do it themselves, since the jobs of a sweep share the processors.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in COUNTS):
        allowed = allowed_processors()
        if allowed < processors():  # PyTorch keeps to the affinity mask by itself
            os.environ["OMP_NUM_THREADS"] = str(allowed)
