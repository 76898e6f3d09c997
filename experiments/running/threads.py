"""The number of threads of a run."""

import logging
import os

import torch

from dolens.errors import InputError
from dolens.threads import allowed_processors

logger = logging.getLogger(__name__)


def set_threads(threads: int | None) -> None:
    """Give PyTorch, and the kernels with it, so many threads.

    Args:
        threads: None leaves PyTorch's own choice, a thread on each core of the machine, but takes
            no more than the processors that this process may use.  OMP_NUM_THREADS and
            MKL_NUM_THREADS come first.

    Raises:
        InputError: fewer than one.
    """
    if threads is not None:
        if threads < 1:
            raise InputError(f"threads: {threads}; allowed: 1 or more, or null")
        torch.set_num_threads(threads)
        return
    if "OMP_NUM_THREADS" in os.environ or "MKL_NUM_THREADS" in os.environ:
        return
    own, allowed = torch.get_num_threads(), allowed_processors()
    if own > allowed:
        torch.set_num_threads(allowed)
        logger.info(
            "threads: %d, since this process may use no more processors (PyTorch would take %d)",
            allowed,
            own,
        )
