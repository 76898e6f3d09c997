"""A radial phase φ = m·q·h(q) with q = (r/R)², h = p2 + p4·q + ...; numbers: m, R, p2, p4, ..."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, deflect, deflect_adjoint, divide
from dolens.kernels.cuda.functions import LawFunctions
from dolens.kernels.cuda.layout import LENGTH, NUMBERS


@triton.jit
def _horner(numbers, codes, x, y):
    """Return m, 1/R², q, h, h' and h''/2."""
    inverse = divide(1.0 + tl.zeros_like(x), tl.load(numbers + 1) + tl.zeros_like(x))
    u, v = inverse * x, inverse * y
    q = u * u + v * v
    h, d, e = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    count = tl.load(codes + LENGTH) - tl.load(codes + NUMBERS)
    for i in range(count - 2):
        e = e * q + d
        d = d * q + h
        h = h * q + tl.load(numbers + count - 1 - i)
    return tl.load(numbers), inverse * inverse, q, h, d, e


@triton.jit
def radial_forward(numbers, codes, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Deflect rays by a radial phase."""
    order, squared, q, h, d, _ = _horner(numbers, codes, x, y)
    slope = 2.0 * order * squared * (h + q * d)
    return deflect(
        order * (q * h), slope * x, slope * y,
        l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    )  # fmt: skip


@triton.jit
def radial_adjoint(
    numbers, codes, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    """Sweep cotangents back through a radial phase."""
    order, squared, q, h, d, e = _horner(numbers, codes, x, y)
    slope = 2.0 * order * squared * (h + q * d)
    second = 4.0 * order * squared * squared * (2.0 * d + 2.0 * q * e)
    of_phase, of_px, of_py, qx, qy, a, b, c, vx, vy, vz, of_front, of_behind = deflect_adjoint(
        slope * x, slope * y, slope + second * x * x, second * x * y, slope + second * y * y,
        l, m, n, nx, ny, nz, index, ratio, per_radian, out_l, out_m, out_n, a, b, c, path,
    )  # fmt: skip
    of_slope = 2.0 * squared * (x * of_px + y * of_py)
    lower = order + tl.zeros_like(x)
    for j in range(tl.load(codes + LENGTH) - tl.load(codes + NUMBERS) - 2):
        upper = lower * q
        add_sum(sums + 2 + j, of_phase * upper + (j + 1.0) * of_slope * lower, alive)
        lower = upper
    return qx, qy, a, b, c, vx, vy, vz, of_front, of_behind


KERNELS = LawFunctions(radial_forward, radial_adjoint)
