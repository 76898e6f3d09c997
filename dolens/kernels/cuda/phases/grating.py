"""Straight grooves, φ = 2π·m·G·y; numbers: order m, grooves G (1/mm)."""

import math

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, deflect, deflect_adjoint
from dolens.kernels.cuda.functions import LawFunctions

_TURN = tl.constexpr(2.0 * math.pi)


@triton.jit
def grating_forward(numbers, codes, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Deflect rays by a grating."""
    slope = _TURN * tl.load(numbers) * tl.load(numbers + 1)
    py = slope + tl.zeros_like(x)
    return deflect(
        slope * y, tl.zeros_like(x), py, l, m, n, nx, ny, nz, index, ratio, per_radian, sense
    )


@triton.jit
def grating_adjoint(
    numbers, codes, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    """Sweep cotangents back through a grating."""
    order = tl.load(numbers)
    zero = tl.zeros_like(x)
    py = _TURN * order * tl.load(numbers + 1) + zero
    of_phase, _, of_py, qx, qy, a, b, c, vx, vy, vz, of_front, of_behind = deflect_adjoint(
        zero, py, zero, zero, zero, l, m, n, nx, ny, nz, index, ratio, per_radian,
        out_l, out_m, out_n, a, b, c, path,
    )  # fmt: skip
    add_sum(sums + 1, _TURN * order * (of_phase * y + of_py), alive)
    return qx, qy, a, b, c, vx, vy, vz, of_front, of_behind


KERNELS = LawFunctions(grating_forward, grating_adjoint)
