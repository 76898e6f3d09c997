"""Straight grooves, φ = 2π·m·G·y; numbers: order m, grooves G (1/mm)."""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import given_by_phase
from dolens.kernels.cpu.compiler import shifted
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    NUMBERS,
    OF_PHASE,
    OF_PHASE_Y,
    OF_RECORD,
    PHASE,
    PHASE_X,
    PHASE_XX,
    PHASE_XY,
    PHASE_Y,
    PHASE_YY,
    POINT_Y,
    WORK_SIZE,
)


def grating_phase(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase and gradient."""
    zero, turn = real(0.0), real(2.0 * math.pi)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q[NUMBERS]), 2)
        slope = turn * p[0] * p[1]
        for i in range(BLOCK):
            w[PHASE + i] = slope * w[POINT_Y + i]
            w[PHASE_X + i], w[PHASE_Y + i] = zero, slope

    return kernel


def grating_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase, gradient and second derivatives, which are zero."""
    zero, turn = real(0.0), real(2.0 * math.pi)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q[NUMBERS]), 2)
        slope = turn * p[0] * p[1]
        for i in range(BLOCK):
            w[PHASE + i] = slope * w[POINT_Y + i]
            w[PHASE_X + i], w[PHASE_Y + i] = zero, slope
            w[PHASE_XX + i], w[PHASE_XY + i], w[PHASE_YY + i] = zero, zero, zero

    return kernel


def grating_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangent of the grooves; the order is no variable."""
    zero, turn = real(0.0), real(2.0 * math.pi)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        order = carray(shifted(record, q[NUMBERS]), 2)[0]
        out = carray(shifted(cotangents, OF_RECORD + BLOCK * q[NUMBERS]), 2 * BLOCK)
        for i in range(BLOCK):
            out[i] = zero
            out[BLOCK + i] = turn * order * (
                w[OF_PHASE + i] * w[POINT_Y + i] + w[OF_PHASE_Y + i]
            )  # fmt: skip

    return kernel


KERNELS = given_by_phase(grating_phase, grating_hessian, grating_parameters)
