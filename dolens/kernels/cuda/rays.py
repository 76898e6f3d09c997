"""These functions read and write a block of rays, and the indices that each of them meets."""

import triton
import triton.language as tl

from dolens.kernels import limits
from dolens.kernels.cuda.layout import SENSE

_FARTHEST, _LONGEST = tl.constexpr(limits.FARTHEST), tl.constexpr(limits.LONGEST)


@triton.jit
def load_vectors(pointer, row, column, rays, mask, third):
    """Load x, y, z of each ray's vector; (0, 0, third) where the mask is off."""
    place = pointer + rays * row
    return (
        tl.load(place, mask=mask, other=0.0),
        tl.load(place + column, mask=mask, other=0.0),
        tl.load(place + 2 * column, mask=mask, other=third),
    )


@triton.jit
def stop_unphysical(x, y, z, l, m, n):
    """Let rays that are none of light stand still at 0, as `finite_rays` does."""
    known = (tl.abs(x) <= _FARTHEST) & (tl.abs(y) <= _FARTHEST) & (tl.abs(z) <= _FARTHEST)
    known &= (tl.abs(l) <= _LONGEST) & (tl.abs(m) <= _LONGEST) & (tl.abs(n) <= _LONGEST)
    return (
        tl.where(known, x, 0.0),
        tl.where(known, y, 0.0),
        tl.where(known, z, 0.0),
        tl.where(known, l, 0.0),
        tl.where(known, m, 0.0),
        tl.where(known, n, 0.0),
    )


@triton.jit
def store_vectors(pointer, rays, mask, x, y, z):
    """Write vectors to (N, 3), contiguous."""
    place = pointer + rays * 3
    tl.store(place, x, mask=mask)
    tl.store(place + 1, y, mask=mask)
    tl.store(place + 2, z, mask=mask)


@triton.jit
def first_sense(values, steps):
    """Return +1 or -1 from the first record: the sense of the axial rays that fill a block up."""
    return tl.load(values + SENSE, mask=steps > 0, other=1.0)


@triton.jit
def load_columns(which, rays, mask):
    """Load each ray's column of the indices; one for all where none is given."""
    if which is None:
        return 0
    else:
        return tl.load(which + rays, mask=mask, other=0)


@triton.jit
def load_media(media, k, wavelengths, columns):
    """Load the index in front of step k, its ratio μ to the one behind, and λ/2π (mm), which only
    the steps of a deflection have.
    """
    front = media + 3 * k * wavelengths + columns
    return tl.load(front), tl.load(front + wavelengths), tl.load(front + 2 * wavelengths)
