"""Arithmetic of a block of rays: clamps, transfer, refraction, deflection by a phase, and sums.

Adjoints stand beside.  It mirrors `dolens.optics.trace` and `dolens.optics.surfaces.refraction`.
Constants take the precision of the rays they meet.

Sums over a block's rays are kept in double precision in a row that belongs to one program.

A program adds in the order of its blocks, with no atomic operations, so that a repeated call gives
the same bits.  Rays that are not `alive` may hold anything, NaN too, and do not count.

Jacobians need what each ray adds.  Their rows belong to one ray each: a place is then a block of
pointers, one for every ray, and nothing is summed over them.
"""

import triton
import triton.language as tl

from dolens.kernels import table
from dolens.kernels.table import LONGEST_WAVEVECTOR, STEEPEST

GRAZING, TINY = tl.constexpr(table.GRAZING), tl.constexpr(table.TINY)
_LONGEST = tl.constexpr(table.LONGEST)


@triton.jit
def divide(a, b):
    """Return a/b, rounded to nearest; Triton's own division of float32 is not."""
    if b.dtype == tl.float64:
        return a / b
    else:
        return tl.div_rn(a, b)


@triton.jit
def safe_sqrt(squared):
    """Return the square root, rounded to nearest; no argument counts as less than 1e-18."""
    held = tl.where(squared > TINY, squared, TINY)
    if held.dtype == tl.float64:
        return tl.sqrt(held)
    else:
        return tl.sqrt_rn(held)


@triton.jit
def clamp(value, limit):
    """Return the value, held within ± limit; NaN stays."""
    value = tl.where(value < -limit, -limit, value)
    return tl.where(value > limit, limit, value)


@triton.jit
def finite(value):
    """Return the number, or zero where it has overflowed."""
    return tl.where(tl.abs(value) < float("inf"), value, 0.0)


@triton.jit
def away_from_zero(value):
    """Return the value, or ± 1e-9 of its sign where it is smaller."""
    size = tl.abs(value)
    size = tl.where(size > GRAZING, size, GRAZING)
    return tl.where(value < 0.0, -size, size)


@triton.jit
def distance_to_plane(z, n, sense):
    """Return the distance (mm) along rays to the plane z = 0, and whether they approach it."""
    towards = sense * n
    return divide(-sense * z, tl.where(towards > GRAZING, towards, GRAZING)), towards > GRAZING


@triton.jit
def refract(l, m, n, nx, ny, nz, ratio, sense):
    """Return the directions behind a surface, and cos² of the angle there: positive without TIR."""
    cosine = clamp(l * nx + m * ny + n * nz, _LONGEST)
    squared = (1.0 - ratio * ratio) + (ratio * ratio) * (cosine * cosine)
    along = sense * safe_sqrt(squared) - ratio * cosine
    return (
        clamp(ratio * l + along * nx, _LONGEST),
        clamp(ratio * m + along * ny, _LONGEST),
        clamp(ratio * n + along * nz, _LONGEST),
        squared,
    )


@triton.jit
def refract_adjoint(a, b, c, l, m, n, nx, ny, nz, out_l, out_m, out_n, ratio, front):
    """Return the cotangents of direction, normal and both indices from (a, b, c), that of d'.

    d' = μ·d + Γ·N with Γ = s·cos t - μ·cos i, and s·cos t = d'·N.
    """
    cosine = l * nx + m * ny + n * nz
    inverse = divide(1.0, out_l * nx + out_m * ny + out_n * nz)
    along = (out_l * nx + out_m * ny + out_n * nz) - ratio * cosine
    of_along = a * nx + b * ny + c * nz
    of_cosine = of_along * (ratio * ratio * cosine * inverse - ratio)
    of_ratio = (a * l + b * m + c * n) - of_along * (
        ratio * (1.0 - cosine * cosine) * inverse + cosine
    )
    of_front = divide(of_ratio * ratio, front)
    return (
        ratio * a + of_cosine * nx,
        ratio * b + of_cosine * ny,
        ratio * c + of_cosine * nz,
        along * a + of_cosine * l,
        along * b + of_cosine * m,
        along * c + of_cosine * n,
        of_front,
        -of_front * ratio,
    )


@triton.jit
def add_sum(place, numbers, alive):
    """Add the sum over the rays that are alive to the number at `place`; or what each ray adds to
    the number at its own place, in the rays' precision.
    """
    counted = tl.where(alive, numbers, 0.0)
    if place.type.is_block():
        tl.store(place, tl.load(place) + counted)
    else:
        tl.store(place, tl.load(place) + tl.sum(counted, 0).to(tl.float64))


@triton.jit
def first_of(keys, left):
    """Return the smallest key among the rays that are left, and which of them have it."""
    key = tl.min(tl.where(left, keys, 2147483647), 0)
    return key, left & (keys == key)


@triton.jit
def add_by_column(front, behind, column, of_front, of_behind, alive):
    """Add cotangents of the indices of two media, each ray's to that of its own wavelength."""
    left = alive
    while tl.max(left.to(tl.int32), 0) > 0:
        wavelength, here = first_of(column, left)
        add_sum(front + wavelength, of_front, here)
        add_sum(behind + wavelength, of_behind, here)
        left = left & (column != wavelength)


_STEEPEST = tl.constexpr(STEEPEST)
_LONGEST_WAVEVECTOR = tl.constexpr(LONGEST_WAVEVECTOR)


@triton.jit
def deflect(phase, px, py, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Return the directions behind a phase of this value and gradient, cos² of the angle there
    (positive if the order is not evanescent), and the path that it adds.
    """
    scale = divide(per_radian * ratio, index)
    gx, gy = scale * px, scale * py
    bx, by, az = ratio * l, ratio * m, ratio * n
    ax, ay = bx + gx, by + gy
    along = clamp(ax * nx + ay * ny + az * nz, _LONGEST_WAVEVECTOR)
    more = gx * (ax + bx) + gy * (ay + by)
    squared = (1.0 - ratio * ratio) - more + along * along
    squared = tl.where(tl.abs(gx) + tl.abs(gy) < _STEEPEST, squared, -1.0)
    change = sense * safe_sqrt(squared) - along
    return (
        clamp(ax + change * nx, _LONGEST),
        clamp(ay + change * ny, _LONGEST),
        clamp(az + change * nz, _LONGEST),
        squared,
        per_radian * phase,
    )


@triton.jit
def deflect_adjoint(
    px, py, xx, xy, yy, l, m, n, nx, ny, nz, index, ratio, per_radian,
    out_l, out_m, out_n, a, b, c, path,
):  # fmt: skip
    """Return the cotangents of the phase and its gradient; and as a law's adjoint does, of x and y,
    the direction, the normal, and both indices.
    """
    per_index = divide(ratio, index)
    scale = per_radian * per_index
    gx, gy = scale * px, scale * py
    ax, ay, az = ratio * l + gx, ratio * m + gy, ratio * n
    inside = out_l * nx + out_m * ny + out_n * nz
    along = ax * nx + ay * ny + az * nz
    change = inside - along
    of_change = a * nx + b * ny + c * nz
    e = divide(of_change, inside)
    of_along = e * along - of_change
    tx, ty, tz = a + of_along * nx, b + of_along * ny, c + of_along * nz
    of_gx, of_gy = tx - e * ax, ty - e * ay
    of_ratio = (l * tx + m * ty + n * tz) - e * (ratio + gx * l + gy * m)
    of_phase, of_px, of_py = per_radian * path, scale * of_gx, scale * of_gy
    return (
        of_phase,
        of_px,
        of_py,
        of_phase * px + of_px * xx + of_py * xy,
        of_phase * py + of_px * xy + of_py * yy,
        ratio * (tx - e * gx),
        ratio * (ty - e * gy),
        ratio * tz,
        change * a + of_along * ax,
        change * b + of_along * ay,
        change * c + of_along * az,
        of_ratio * per_index,
        -(of_ratio * ratio + gx * of_gx + gy * of_gy) * per_index,
    )
