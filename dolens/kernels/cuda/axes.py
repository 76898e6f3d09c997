"""Rays change their axes between surfaces of different poses.

They mirror `change_axes` and `to_lens_axes` of `dolens.optics.elements`.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import GRAZING, add_sum, divide
from dolens.kernels.cuda.layout import (
    STEP_X,
    STEP_Y,
    STEP_Z,
    TURN_XX,
    TURN_XY,
    TURN_XZ,
    TURN_YX,
    TURN_YY,
    TURN_YZ,
    TURN_ZX,
    TURN_ZY,
    TURN_ZZ,
)


@triton.jit
def _rotation(record):
    """Load R by rows."""
    return (
        tl.load(record + TURN_XX),
        tl.load(record + TURN_XY),
        tl.load(record + TURN_XZ),
        tl.load(record + TURN_YX),
        tl.load(record + TURN_YY),
        tl.load(record + TURN_YZ),
        tl.load(record + TURN_ZX),
        tl.load(record + TURN_ZY),
        tl.load(record + TURN_ZZ),
    )


@triton.jit
def _turn(record, x, y, z):
    """Return R·v."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(record)
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@triton.jit
def _turn_back(record, x, y, z):
    """Return Rᵀ·v."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(record)
    return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z


@triton.jit
def _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive):
    """Add the cotangents of R, which turned (x, y, z) to one of cotangent (px, py, pz), and d."""
    add_sum(sums + TURN_XX, px * x + a * l, alive)
    add_sum(sums + TURN_XY, px * y + a * m, alive)
    add_sum(sums + TURN_XZ, px * z + a * n, alive)
    add_sum(sums + TURN_YX, py * x + b * l, alive)
    add_sum(sums + TURN_YY, py * y + b * m, alive)
    add_sum(sums + TURN_YZ, py * z + b * n, alive)
    add_sum(sums + TURN_ZX, pz * x + c * l, alive)
    add_sum(sums + TURN_ZY, pz * y + c * m, alive)
    add_sum(sums + TURN_ZZ, pz * z + c * n, alive)


@triton.jit
def change_axes(record, x, y, z, l, m, n):
    """Carry rays along their line to the level of the next vertex, and turn them.

    Those that run along that level are turned where they are.  Returns position, direction, and
    the distance.
    """
    crosses = tl.abs(n) > GRAZING
    below = tl.load(record + STEP_Z) - z
    t = tl.where(crosses, divide(below, tl.where(crosses, n, 1.0)), 0.0)
    x = x - tl.load(record + STEP_X) + t * l
    y = y - tl.load(record + STEP_Y) + t * m
    x, y, z = _turn(record, x, y, tl.where(crosses, 0.0, -below))
    l, m, n = _turn(record, l, m, n)
    return x, y, z, l, m, n, t


@triton.jit
def change_axes_adjoint(record, sums, index, x, y, z, l, m, n, t, px, py, pz, a, b, c, path, alive):
    """Return the cotangents in front of `change_axes`, and that of the index, from those behind it.

    Args x to n are the ray in front, t the distance, px to c and path the cotangents behind.
    """
    x = x - tl.load(record + STEP_X) + t * l
    y = y - tl.load(record + STEP_Y) + t * m
    crosses = tl.abs(n) > GRAZING
    z = tl.where(crosses, 0.0, z - tl.load(record + STEP_Z))
    _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive)
    qx, qy, qz = _turn_back(record, px, py, pz)
    a, b, c = _turn_back(record, a, b, c)
    along = divide(qx * l + qy * m + index * path, tl.where(crosses, n, 1.0))
    along = tl.where(crosses, along, -qz)
    add_sum(sums + STEP_X, -qx, alive)
    add_sum(sums + STEP_Y, -qy, alive)
    add_sum(sums + STEP_Z, along, alive)
    return qx, qy, -along, a + t * qx, b + t * qy, c - t * along, path * t


@triton.jit
def lens_axes(record, x, y, z, l, m, n):
    """Return position and direction in the lens's axes."""
    x, y, z = _turn(record, x, y, z)
    l, m, n = _turn(record, l, m, n)
    return (
        x + tl.load(record + STEP_X),
        y + tl.load(record + STEP_Y),
        z + tl.load(record + STEP_Z),
        l,
        m,
        n,
    )


@triton.jit
def lens_axes_adjoint(record, sums, x, y, z, l, m, n, px, py, pz, a, b, c, alive):
    """Return the cotangents in front of `lens_axes` from those behind it."""
    add_sum(sums + STEP_X, px, alive)
    add_sum(sums + STEP_Y, py, alive)
    add_sum(sums + STEP_Z, pz, alive)
    _turn_sums(sums, px, py, pz, x, y, z, a, b, c, l, m, n, alive)
    px, py, pz = _turn_back(record, px, py, pz)
    a, b, c = _turn_back(record, a, b, c)
    return px, py, pz, a, b, c
