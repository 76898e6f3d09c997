"""Arithmetic of a block of rays: clamps, transfer, and sums.

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

GRAZING, TINY = tl.constexpr(table.GRAZING), tl.constexpr(table.TINY)


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
