"""An odd asphere has the sag s = even asphere + r·(a1 + q·H(q)), q = r² and H = a3 + a5·q + ....

The record holds the even asphere's numbers, then a1 and the coefficients of H, which come in
groups of four.
"""

import math
from collections.abc import Callable

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.even_asphere import (
    COEFFICIENTS,
    H_SECOND,
    H_SLOPE,
    OF_COEFFICIENTS,
    H,
    Q,
    even_asphere_hessian,
    even_asphere_parameters,
    even_asphere_sag,
    horner,
)
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    COLUMNS,
    COUNT,
    OF_SAG,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
    WORK_SIZE,
)

# mm²: closer to the axis than its root a point counts as the vertex, as in the reference.
VERTEX = 1e-30
# Work rows of the cotangents: r^(2j+1), the weight of its slope times r², and q.
LOWER, OF_SLOPE = H, H_SLOPE


def odd_asphere_sag(real: types.Type) -> Callable[..., None]:
    """Add the odd powers to the rows of sag and slopes."""
    even = njit(**OPTIONS)(even_asphere_sag(real))
    first, _ = horner(real)
    zero, one, two, three, vertex = real(0.0), real(1.0), real(2.0), real(3.0), real(VERTEX)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        even(before, after, cotangents, record, work, codes)
        w, codes_row = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        own = shifted(record, codes_row[COUNT])
        a1 = carray(own, UNBOUNDED)[COEFFICIENTS]
        first(w, shifted(own, 1), codes_row[COLUMNS])
        for i in range(BLOCK):
            q, h, d = w[Q + i], w[H + i], w[H_SLOPE + i]
            away = q > vertex
            root = math.sqrt(q if away else one)
            r, inverse = root if away else zero, one / root if away else zero
            slope = a1 * inverse + r * (three * h + two * q * d)
            w[SAG + i] += r * (a1 + q * h)
            w[SLOPE_X + i] += w[POINT_X + i] * slope
            w[SLOPE_Y + i] += w[POINT_Y + i] * slope

    return kernel


def odd_asphere_hessian(real: types.Type) -> Callable[..., None]:
    """Add the odd powers to the rows of slopes and second derivatives.

    With P(r) and g = P'/r: s_xx = g + (x/r)²·(P'' - g), and P'' - g has no cancellation: -a1/r +
    r·(3H + 12q·H' + 4q²·H'').
    """
    even = njit(**OPTIONS)(even_asphere_hessian(real))
    _, second = horner(real)
    zero, one, two, three = real(0.0), real(1.0), real(2.0), real(3.0)
    twelve, eight, vertex = real(12.0), real(8.0), real(VERTEX)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        even(before, after, cotangents, record, work, codes)
        w, codes_row = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        own = shifted(record, codes_row[COUNT])
        a1 = carray(own, UNBOUNDED)[COEFFICIENTS]
        second(w, shifted(own, 1), codes_row[COLUMNS])
        for i in range(BLOCK):
            x, y, q = w[POINT_X + i], w[POINT_Y + i], w[Q + i]
            h, d, e = w[H + i], w[H_SLOPE + i], w[H_SECOND + i]
            away = q > vertex
            root = math.sqrt(q if away else one)
            r, inverse = root if away else zero, one / root if away else zero
            slope = a1 * inverse + r * (three * h + two * q * d)
            more = r * (three * h + q * (twelve * d + eight * q * e)) - a1 * inverse
            u, v = x * inverse, y * inverse
            w[SLOPE_X + i] += x * slope
            w[SLOPE_Y + i] += y * slope
            w[SAG_XX + i] += slope + u * u * more
            w[SAG_XY + i] += u * v * more
            w[SAG_YY + i] += slope + v * v * more

    return kernel


def odd_asphere_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the even asphere's numbers, of a1 and of the coefficients of H."""
    even = njit(**OPTIONS)(even_asphere_parameters(real))
    zero, one, vertex = real(0.0), real(1.0), real(VERTEX)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        even(before, after, cotangents, record, work, codes)
        w, codes_row = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        own = shifted(cotangents, OF_COEFFICIENTS + BLOCK * codes_row[COUNT])
        of_a1 = carray(own, BLOCK)
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            q = x * x + y * y
            away = q > vertex
            root = math.sqrt(q if away else one)
            r, inverse = root if away else zero, one / root if away else zero
            of_slope = (w[OF_SLOPE_X + i] * x + w[OF_SLOPE_Y + i] * y) * inverse
            of_a1[i] = w[OF_SAG + i] * r + of_slope
            w[Q + i], w[LOWER + i], w[OF_SLOPE + i] = q, r, of_slope * r
        for j in range(codes_row[COLUMNS]):
            out = carray(shifted(own, BLOCK * (j + 1)), BLOCK)
            power = real(2 * j + 3)
            for i in range(BLOCK):
                # of_sag·r^n + of_slope·n·r^(n-1) with n = 2j + 3.
                lower = w[LOWER + i]
                upper = lower * w[Q + i]
                out[i] = w[OF_SAG + i] * upper + power * w[OF_SLOPE + i] * lower
                w[LOWER + i] = upper

    return kernel


KERNELS = given_by_sag(
    odd_asphere_sag, odd_asphere_hessian, odd_asphere_parameters, starts_on_conic=True
)
