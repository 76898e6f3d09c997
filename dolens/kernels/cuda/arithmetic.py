"""All surfaces share these functions of a block: clamps, transfer, Snell's law, and its adjoint.

It mirrors `dolens.optics.trace` and `dolens.optics.surfaces.refraction`.  Constants take the
precision of the rays they meet.
"""

import triton
import triton.language as tl

from dolens.kernels import limits

GRAZING, TINY = tl.constexpr(limits.GRAZING), tl.constexpr(limits.TINY)
_LONGEST = tl.constexpr(limits.LONGEST)


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
