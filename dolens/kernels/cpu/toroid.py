"""A toroid has the sag s = f + c·x²/(g + W) with g = 1 - c·f and W² = g² - c²·x², W = 1 - c·s.

f is the section of an even asphere along y, whose kernels run with x = 0.  The record holds the
even asphere's numbers, and then c, the curvature along x.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, call_block
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    ASPHERE_HESSIAN,
    ASPHERE_PARAMETERS,
    ASPHERE_SAG,
    BEHIND_ASPHERE,
    BLOCK,
    CODE_ROW,
    COUNT,
    FURTHER,
    MARGIN,
    OF_BEHIND_ASPHERE,
    OF_SAG,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    POINT_X,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
)
from dolens.kernels.limits import GRAZING, TINY

# A work row of its own: x, while the section is evaluated at x = 0.
KEPT_X, CURVE = FURTHER, FURTHER + BLOCK
ROWS = 2


@cache
def _rotation(real: types.Type) -> tuple[Any, Any, Any]:
    """Compile the step to x = 0 and back, and the roots."""
    zero, one, grazing, tiny = real(0.0), real(1.0), real(GRAZING), real(TINY)

    @njit(**OPTIONS)
    def to_section(w):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            w[KEPT_X + i] = w[POINT_X + i]
            w[POINT_X + i] = zero

    @njit(**OPTIONS)
    def back(w):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            w[POINT_X + i] = w[KEPT_X + i]

    @njit(**OPTIONS)
    def roots(c, f, x):  # noqa: ANN001, ANN202
        """Return g, W², W, and whether the circle is there."""
        g = one - c * f
        g = g if g > grazing else grazing
        squared = g * g - c * x * c * x
        on = squared > tiny
        return g, squared, math.sqrt(squared if on else tiny), on

    return to_section, back, roots


def toroid_sag(real: types.Type) -> Callable[..., None]:
    """Fill the rows of sag, slopes, and a margin that is positive where curve and circle are."""
    to_section, back, roots = _rotation(real)
    one, two = real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        c = carray(record, UNBOUNDED)[BEHIND_ASPHERE + q[COUNT]]
        to_section(w)
        call_block(q[ASPHERE_SAG], before, after, cotangents, record, work, codes)
        back(w)
        for i in range(BLOCK):
            x, f, slope = w[POINT_X + i], w[SAG + i], w[SLOPE_Y + i]
            g, squared, root, on = roots(c, f, x)
            inverse = one / (root if on else g)
            bent = c * x * inverse
            w[SAG + i] = f + c * x * x / (g + root)
            w[SLOPE_X + i] = bent if on else two * bent
            w[SLOPE_Y + i] = slope * (g * inverse if on else one + bent * bent)
            margin = w[MARGIN + i]
            margin = squared if squared < margin else margin
            towards = one - c * f
            w[MARGIN + i] = towards if towards < margin else margin

    return kernel


def toroid_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of slopes and second derivatives.

    W·s_xx = c + c·s_x², W·s_xy = c·s_x·s_y and W·s_yy = g·f'' + c·(s_y² - f'²).
    """
    to_section, back, roots = _rotation(real)
    one = real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        c = carray(record, UNBOUNDED)[BEHIND_ASPHERE + q[COUNT]]
        to_section(w)
        call_block(q[ASPHERE_SAG], before, after, cotangents, record, work, codes)
        call_block(q[ASPHERE_HESSIAN], before, after, cotangents, record, work, codes)
        back(w)
        for i in range(BLOCK):
            x, f, slope, second = w[POINT_X + i], w[SAG + i], w[SLOPE_Y + i], w[SAG_YY + i]
            g, _, root, _ = roots(c, f, x)
            inverse = one / root
            sx, sy = c * x * inverse, slope * g * inverse
            w[SLOPE_X + i], w[SLOPE_Y + i] = sx, sy
            w[SAG_XX + i] = c * (one + sx * sx) * inverse
            w[SAG_XY + i] = c * sx * sy * inverse
            w[SAG_YY + i] = (g * second + c * (sy * sy - slope * slope)) * inverse
            w[CURVE + i] = f

    return kernel


def toroid_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the curve's numbers and of c.

    Of c: W·s_c = (s² + x² - f²)/2.  Of the curve's numbers: s_θ = (g/W)·f_θ, so the section's own
    kernel takes the cotangents times g/W, and what the slopes of g/W add.  `toroid_hessian` has
    left f.
    """
    to_section, back, roots = _rotation(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        count = q[COUNT]
        c = carray(record, UNBOUNDED)[BEHIND_ASPHERE + count]
        cot = carray(cotangents, UNBOUNDED)
        for i in range(BLOCK):
            x, f = w[POINT_X + i], w[CURVE + i]
            of_sag, of_x, of_y = w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i]
            g, _, root, _ = roots(c, f, x)
            inverse = one / root
            ratio = g * inverse
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            slope = sy / ratio
            s = f + c * x * x / (g + root)
            along = of_x * sx + of_y * sy
            # (s² - f²)/2 without cancellation.
            lever = half * ((s - f) * (s + f) + x * x)
            of_lever = s * along + x * of_x - f * slope * of_y
            cot[OF_BEHIND_ASPHERE + BLOCK * count + i] = inverse * (
                of_sag * lever + of_lever + c * lever * along * inverse
            )
            w[OF_SAG + i] = of_sag * ratio + c * (ratio * along - slope * of_y) * inverse
            w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i] = zero, ratio * of_y
        to_section(w)
        call_block(q[ASPHERE_PARAMETERS], before, after, cotangents, record, work, codes)
        back(w)

    return kernel


def _rows(row: object) -> int:
    """Return the number of work rows of its own."""
    return ROWS


KERNELS = given_by_sag(
    toroid_sag, toroid_hessian, toroid_parameters, scratch=_rows, on_asphere=True
)
