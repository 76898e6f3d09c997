"""Threads, precision of matrix products and inherited environment variables of a process.

PyTorch is imported where it is told: what starts processes needs the variables alone.
"""

import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

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
    import torch

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


def set_matmul_precision(precision: str) -> None:
    """Set how float32 matrix products are rounded on the device, for all of the process.

    PyTorch 2.9 warns of a newer interface, which later versions prefer without a warning.

    Args:
        precision: `highest`, `high` (TensorFloat32) or `medium` (bfloat16).
    """
    import torch

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Please use the new API settings", UserWarning)
        torch.set_float32_matmul_precision(precision)


@contextmanager
def environment_variables(values: Mapping[str, str]) -> Iterator[None]:
    """Set variables for processes that begin meanwhile, and put back what was there."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
