"""Sums over a block's rays are kept in double precision in a row that belongs to one program.

A program adds in the order of its blocks, with no atomic operations, so that a repeated call gives
the same bits.  Rays that are not `alive` may hold anything, NaN too, and do not count.

Jacobians need what each ray adds.  Their rows belong to one ray each: a place is then a block of
pointers, one for every ray, and nothing is summed over them.
"""

import triton
import triton.language as tl


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
