"""Steps between surfaces of different poses, and their adjoints.

They mirror `change_axes` and `to_lens_axes` of `dolens.optics.elements`.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import GRAZING, divide
from dolens.kernels.cuda.layout import STEP, TURN
from dolens.kernels.cuda.sums import add_sum


@triton.jit
def _turn(record, x, y, z):
    """R·v, with R by rows."""
    r = record + TURN
    return (
        tl.load(r) * x + tl.load(r + 1) * y + tl.load(r + 2) * z,
        tl.load(r + 3) * x + tl.load(r + 4) * y + tl.load(r + 5) * z,
        tl.load(r + 6) * x + tl.load(r + 7) * y + tl.load(r + 8) * z,
    )


@triton.jit
def _turn_back(record, x, y, z):
    """Rᵀ·v."""
    r = record + TURN
    return (
        tl.load(r) * x + tl.load(r + 3) * y + tl.load(r + 6) * z,
        tl.load(r + 1) * x + tl.load(r + 4) * y + tl.load(r + 7) * z,
        tl.load(r + 2) * x + tl.load(r + 5) * y + tl.load(r + 8) * z,
    )


@triton.jit
def _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive):
    """Add the cotangents of R, which turned (x, y, z) to one of cotangent (px, py, pz), and d."""
    r = sums + TURN
    add_sum(r, px * x + a * l, alive)
    add_sum(r + 1, px * y + a * m, alive)
    add_sum(r + 2, px * z + a * n, alive)
    add_sum(r + 3, py * x + b * l, alive)
    add_sum(r + 4, py * y + b * m, alive)
    add_sum(r + 5, py * z + b * n, alive)
    add_sum(r + 6, pz * x + c * l, alive)
    add_sum(r + 7, pz * y + c * m, alive)
    add_sum(r + 8, pz * z + c * n, alive)


@triton.jit
def change_axes(record, x, y, z, l, m, n):
    """Carry rays along their line to the level of the next vertex, and turn them.

    Those that run along that level are turned where they are.  Returns position, direction, and
    the distance.
    """
    step = record + STEP
    crosses = tl.abs(n) > GRAZING
    below = tl.load(step + 2) - z
    t = tl.where(crosses, divide(below, tl.where(crosses, n, 1.0)), 0.0)
    x = x - tl.load(step) + t * l
    y = y - tl.load(step + 1) + t * m
    x, y, z = _turn(record, x, y, tl.where(crosses, 0.0, -below))
    l, m, n = _turn(record, l, m, n)
    return x, y, z, l, m, n, t


@triton.jit
def change_axes_adjoint(record, sums, index, x, y, z, l, m, n, t, px, py, pz, a, b, c, path, alive):
    """Cotangents in front of `change_axes`, and that of the index, from those behind it.

    Args x to n are the ray in front, t the distance, px to c and path the cotangents behind.
    """
    step, of_step = record + STEP, sums + STEP
    x = x - tl.load(step) + t * l
    y = y - tl.load(step + 1) + t * m
    crosses = tl.abs(n) > GRAZING
    z = tl.where(crosses, 0.0, z - tl.load(step + 2))
    _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive)
    qx, qy, qz = _turn_back(record, px, py, pz)
    a, b, c = _turn_back(record, a, b, c)
    along = divide(qx * l + qy * m + index * path, tl.where(crosses, n, 1.0))
    along = tl.where(crosses, along, -qz)
    add_sum(of_step, -qx, alive)
    add_sum(of_step + 1, -qy, alive)
    add_sum(of_step + 2, along, alive)
    return qx, qy, -along, a + t * qx, b + t * qy, c - t * along, path * t


@triton.jit
def lens_axes(record, x, y, z, l, m, n):
    """See rays from the lens's axes: position and direction."""
    step = record + STEP
    x, y, z = _turn(record, x, y, z)
    l, m, n = _turn(record, l, m, n)
    return x + tl.load(step), y + tl.load(step + 1), z + tl.load(step + 2), l, m, n


@triton.jit
def lens_axes_adjoint(record, sums, x, y, z, l, m, n, px, py, pz, a, b, c, alive):
    """Cotangents in front of `lens_axes` from those behind it."""
    of_step = sums + STEP
    add_sum(of_step, px, alive)
    add_sum(of_step + 1, py, alive)
    add_sum(of_step + 2, pz, alive)
    _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive)
    px, py, pz = _turn_back(record, px, py, pz)
    a, b, c = _turn_back(record, a, b, c)
    return px, py, pz, a, b, c
