"""The OpenMP whose threads are PyTorch's."""

import ctypes
import logging
from functools import cache

import torch

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
