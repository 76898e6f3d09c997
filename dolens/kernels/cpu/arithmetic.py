"""Arithmetic of one ray at any surface: clamps, transfer, and refraction.

Adjoints stand beside.  They mirror `dolens.optics.trace` and `dolens.optics.surfaces.refraction`.
"""

import math
from functools import cache
from typing import Any, NamedTuple

from numba import njit, types

from dolens.kernels.cpu.compiler import OPTIONS
from dolens.kernels.cpu.layout import (
    ENDED,
    MISSED,
    STOPPED,
    TOTALLY_REFLECTED,
    VIGNETTED,
)
from dolens.kernels.table import GRAZING, LONGEST, TINY


class Arithmetic(NamedTuple):
    """These compiled scalar functions of one real type are inlined in a block's loop."""

    clamp: Any
    safe_sqrt: Any
    arrive: Any
    set_status: Any
    refract: Any
    refract_adjoint: Any


@cache
def arithmetic(real: types.Type) -> Arithmetic:
    """Compile the functions for a real type; every constant in them has it, so that none is
    promoted.
    """
    grazing, tiny = real(GRAZING), real(TINY)
    zero, one, longest = real(0.0), real(1.0), real(LONGEST)
    stopped, totally_reflected = real(STOPPED), real(TOTALLY_REFLECTED)
    missed = real(MISSED)

    @njit(**OPTIONS)
    def clamp(value, limit):  # noqa: ANN001, ANN202
        """Return the value, held within ± limit; NaN stays."""
        low = -limit
        value = low if value < low else value
        return limit if value > limit else value

    @njit(**OPTIONS)
    def safe_sqrt(squared):  # noqa: ANN001, ANN202
        """Return the square root; an argument that is not positive counts as 1e-18."""
        return math.sqrt(squared if squared > tiny else tiny)

    @njit(**OPTIONS)
    def arrive(x, y, z, l, m, n, sense, limit):  # noqa: ANN001, ANN202, E741
        """Return x and y on the vertex plane, the distance there, and the cosine in the sense of
        travel, which is zero where x or y is held at the limit.
        """
        towards = sense * n
        t = -sense * z / (towards if towards > grazing else grazing)
        x, y = clamp(x + t * l, limit), clamp(y + t * m, limit)
        towards = towards if math.fabs(x) < limit else zero
        return x, y, t, towards if math.fabs(y) < limit else zero

    @njit(**OPTIONS)
    def set_status(src, dst, i, tag, edge, x, y, met, least, transmitted):  # noqa: ANN001, ANN202
        """Set the status of ray i behind a surface; the first failure of each kind stays.

        Args: the states in front and behind; i; the surface's tag, and its circular edge's radius
        squared; where the ray meets it; a number that exceeds `least` if it does; and cos² behind,
        which is positive without total reflection.
        """
        ended, vignetted = src[ENDED + i], src[VIGNETTED + i]
        ended = ended if ended > zero or met > least else tag + missed
        dst[ENDED + i] = ended if ended > zero or transmitted > zero else tag + totally_reflected
        inside = edge - (x * x + y * y)
        dst[VIGNETTED + i] = vignetted if vignetted > zero or inside > zero else tag + stopped

    @njit(**OPTIONS)
    def refract(l, m, n, nx, ny, nz, ratio, sense):  # noqa: ANN001, ANN202, E741
        """Return direction and cos² of the angle behind a surface; it is positive without TIR."""
        cosine = clamp(l * nx + m * ny + n * nz, longest)
        squared = (one - ratio * ratio) + (ratio * ratio) * (cosine * cosine)
        along = sense * safe_sqrt(squared) - ratio * cosine
        return (
            clamp(ratio * l + along * nx, longest),
            clamp(ratio * m + along * ny, longest),
            clamp(ratio * n + along * nz, longest),
            squared,
        )

    @njit(**OPTIONS)
    def refract_adjoint(a, b, c, l, m, n, nx, ny, nz, out_l, out_m, out_n, ratio, per_index):  # noqa: ANN001, ANN202, E741
        """Return the cotangents of direction, normal and both indices from (a, b, c), that of d',
        and 1/cos i.

        d' = μ·d + Γ·N with Γ = s·cos t - μ·cos i, and s·cos t = d'·N.  `per_index` is one over the
        index in front.  One division serves both cosines.
        """
        cosine = l * nx + m * ny + n * nz
        inside = out_l * nx + out_m * ny + out_n * nz
        both = one / (cosine * inside)
        along = inside - ratio * cosine
        of_along = a * nx + b * ny + c * nz
        refracted = ratio * both * cosine
        of_cosine = of_along * (ratio * refracted * cosine - ratio)
        of_ratio = (a * l + b * m + c * n) - of_along * (
            refracted * (one - cosine * cosine) + cosine
        )
        of_before = of_ratio * ratio * per_index
        return (
            ratio * a + of_cosine * nx,
            ratio * b + of_cosine * ny,
            ratio * c + of_cosine * nz,
            along * a + of_cosine * l,
            along * b + of_cosine * m,
            along * c + of_cosine * n,
            of_before,
            -of_before * ratio,
            both * inside,
        )

    return Arithmetic(clamp, safe_sqrt, arrive, set_status, refract, refract_adjoint)
