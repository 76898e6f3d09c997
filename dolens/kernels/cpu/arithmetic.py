"""Arithmetic of one ray at any surface: clamps, transfer, and refraction.

Those of `dolens.kernels.refraction` are among them; the others mirror `dolens.optics.trace`.
"""

import math
from functools import cache
from typing import Any, NamedTuple

from numba import njit, types

from dolens.kernels import operations
from dolens.kernels.cpu.compiler import OPTIONS
from dolens.kernels.cpu.layout import (
    ENDED,
    MISSED,
    STOPPED,
    TOTALLY_REFLECTED,
    VIGNETTED,
)
from dolens.kernels.cpu.translation import operations_of, scalar
from dolens.kernels.refraction import refract, refract_adjoint
from dolens.kernels.table import GRAZING


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
    grazing, zero = real(GRAZING), real(0.0)
    stopped, totally_reflected = real(STOPPED), real(TOTALLY_REFLECTED)
    missed = real(MISSED)

    known = operations_of(real)
    clamp = known[operations.clamp]

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

    return Arithmetic(
        clamp,
        known[operations.safe_sqrt],
        arrive,
        set_status,
        scalar(refract, real),
        scalar(refract_adjoint, real),
    )
