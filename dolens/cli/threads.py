"""How many threads a command has.

Only the program `dolens` sets this, in its own environment and before PyTorch starts; a program of
a user's that imports dolens keeps what it has.
"""

import os
import sys

from dolens.processors import allowed_processors, processors

COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads() -> None:
    """Have no more threads than a quota allows; a user's own number stays.

    Experiments do it themselves, since the jobs of a sweep share the processors.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in COUNTS):
        allowed = allowed_processors()
        if allowed < processors():  # PyTorch keeps to the affinity mask by itself
            os.environ["OMP_NUM_THREADS"] = str(allowed)
