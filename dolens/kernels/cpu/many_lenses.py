"""The driver of many lenses runs another driver for one lens after the other.

Lenses of one structure share the codes of their steps, so that they differ in addresses only: those
of their numbers, of their indices, of their rays and of what is written.  Each moves on by a fixed
number of bytes from one lens to the next.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numba import carray, types
from torch import Tensor

from dolens.kernels.cpu import compiler, jobs
from dolens.kernels.cpu.compiler import call_driver, int64_at
from dolens.kernels.cpu.layout import UNBOUNDED
from dolens.kernels.cpu.program import Program


def lenses_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that runs the inner driver over all its pieces for lenses `first` to
    `last`.
    """

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        pairs = carray(int64_at(job[jobs.STRIDES]), UNBOUNDED)
        for lens in range(first, last):
            for i in range(job[jobs.STRIDE_PAIRS]):
                job[pairs[2 * i]] += lens * pairs[2 * i + 1]
            call_driver(job[jobs.INNER_DRIVER], job_, 0, job[jobs.INNER_PIECES])
            for i in range(job[jobs.STRIDE_PAIRS]):
                job[pairs[2 * i]] -= lens * pairs[2 * i + 1]

    return kernel


def run_lenses(
    program: Program,
    driver: Callable[[types.Type], Callable[..., None]],
    lenses: int,
    pieces: int,
    by_lens: Mapping[int, Tensor],
    small: int,
) -> None:
    """Run a driver for every lens; threads share lenses, or the pieces of a single one.

    Args:
        program: of the first lens, pointed to everything that the driver needs.
        driver: the factory of the driver of one lens.
        lenses: L.
        pieces: of one lens.
        by_lens: place in the job → tensor (L, ...) whose first lens that place points to; a stride
            of zero shares it.
        small: fewer rays than this, of all lenses, are traced by one thread.
    """
    if lenses == 1:
        program.run(driver, pieces, small)
        return
    pairs = [(place, t.stride(0) * t.element_size()) for place, t in by_lens.items()]
    strides = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    job = program.job
    job[jobs.INNER_DRIVER] = compiler.compile_driver(driver, program.real)
    job[jobs.INNER_PIECES], job[jobs.STRIDE_PAIRS] = pieces, len(strides)
    job[jobs.STRIDES] = strides.ctypes.data
    program.run(lenses_driver, lenses, small, lenses)
