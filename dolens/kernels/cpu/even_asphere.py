"""An even asphere has the sag s = conic + q·a2 + q²·H(q) with q = r² and H = a4 + a6·q + ....

The record holds c, k, a2, and the coefficients of H.  These come in groups of four, so that four
steps are unrolled at a time.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    COUNT,
    MARGIN,
    OF_SAG,
    OF_SECOND,
    OF_SHAPE,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    OWN,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SHAPE,
    SHORT_RECORD,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
    WORK_SIZE,
)

# Work rows: q, H, H' and H''/2; for the cotangents, powers of q and the weight of the slope.
Q, H, H_SLOPE, H_SECOND, *_ = OWN
LOWER, OF_SLOPE = H, H_SLOPE
# The coefficient of r² in a record, the first of H, and their cotangents.
A2, OF_A2 = SHAPE + 2, OF_SECOND + BLOCK
COEFFICIENTS, OF_COEFFICIENTS = A2 + 1, OF_A2 + BLOCK


@cache
def horner(real: types.Type) -> tuple[Any, Any]:
    """Compile Horner's rule for H and H' (and H''/2) of a block; q, too, gets a work row."""
    zero = real(0.0)

    @njit(**OPTIONS)
    def first(w, record, count):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            w[Q + i] = x * x + y * y
            w[H + i], w[H_SLOPE + i] = zero, zero
        for group in range(count // 4 - 1, -1, -1):
            a = carray(shifted(record, COEFFICIENTS + 4 * group), 4)
            a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
            for i in range(BLOCK):
                q, h, d = w[Q + i], w[H + i], w[H_SLOPE + i]
                d, h = d * q + h, h * q + a3
                d, h = d * q + h, h * q + a2
                d, h = d * q + h, h * q + a1
                w[H_SLOPE + i], w[H + i] = d * q + h, h * q + a0

    @njit(**OPTIONS)
    def second(w, record, count):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            w[Q + i] = x * x + y * y
            w[H + i], w[H_SLOPE + i], w[H_SECOND + i] = zero, zero, zero
        for group in range(count // 4 - 1, -1, -1):
            a = carray(shifted(record, COEFFICIENTS + 4 * group), 4)
            a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
            for i in range(BLOCK):
                q, h, d, e = w[Q + i], w[H + i], w[H_SLOPE + i], w[H_SECOND + i]
                e, d, h = e * q + d, d * q + h, h * q + a3
                e, d, h = e * q + d, d * q + h, h * q + a2
                e, d, h = e * q + d, d * q + h, h * q + a1
                w[H_SECOND + i], w[H_SLOPE + i], w[H + i] = e * q + d, d * q + h, h * q + a0

    return first, second


def even_asphere_sag(real: types.Type) -> Callable[..., None]:
    """Fill the rows of sag, slopes, and the margin of the conic's branch."""
    _, safe_sqrt, *_ = arithmetic(real)
    fill_h, _ = horner(real)
    one, two = real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        count = carray(codes, CODE_ROW)[COUNT]
        fill_h(w, record, count)
        c, a2 = p[SHAPE], p[A2]
        ec2 = (one + p[SHAPE + 1]) * c * c
        for i in range(BLOCK):
            q, h, d = w[Q + i], w[H + i], w[H_SLOPE + i]
            squared = one - ec2 * q
            root = safe_sqrt(squared)
            both = c / (root * (one + root))
            twice = both * (one + root) + two * (a2 + q * (two * h + q * d))
            w[SAG + i] = both * root * q + q * (a2 + q * h)
            w[SLOPE_X + i], w[SLOPE_Y + i] = w[POINT_X + i] * twice, w[POINT_Y + i] * twice
            w[MARGIN + i] = squared

    return kernel


def even_asphere_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of slopes and second derivatives: with f(q), s_xx = 2f' + 4x²f'', s_xy =
    4xyf''.
    """
    _, safe_sqrt, *_ = arithmetic(real)
    _, fill_h = horner(real)
    half, one, two, four = real(0.5), real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        count = carray(codes, CODE_ROW)[COUNT]
        fill_h(w, record, count)
        c, a2 = p[SHAPE], p[A2]
        ec2 = (one + p[SHAPE + 1]) * c * c
        for i in range(BLOCK):
            x, y, q = w[POINT_X + i], w[POINT_Y + i], w[Q + i]
            h, d, e = w[H + i], w[H_SLOPE + i], w[H_SECOND + i]
            root = safe_sqrt(one - ec2 * q)
            conic = half * c / root
            slope = conic + a2 + q * (two * h + q * d)
            second = half * conic * ec2 / (root * root) + two * h + four * q * d + two * q * q * e
            w[SLOPE_X + i], w[SLOPE_Y + i] = two * x * slope, two * y * slope
            w[SAG_XX + i] = two * slope + four * x * x * second
            w[SAG_XY + i] = four * x * y * second
            w[SAG_YY + i] = two * slope + four * y * y * second

    return kernel


def even_asphere_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of c, k, a2 and the further coefficients.

    With R = √(1 - (1+k)c²q): s_c = (q + (1+k)s²)/2R and s_k = c·s²/2R of the conic's sag s, and of
    its derivative in q, c/2R: 1/2R³ and c³q/4R³.
    """
    _, safe_sqrt, *_ = arithmetic(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        count = carray(codes, CODE_ROW)[COUNT]
        cot = carray(cotangents, UNBOUNDED)
        c, e = p[SHAPE], one + p[SHAPE + 1]
        for i in range(BLOCK):
            x, y, q = w[POINT_X + i], w[POINT_Y + i], w[Q + i]
            of_sag = w[OF_SAG + i]
            of_slope = two * (w[OF_SLOPE_X + i] * x + w[OF_SLOPE_Y + i] * y)
            inverse = one / safe_sqrt(one - e * c * c * q)
            sag = c * q / (one + one / inverse)
            cubed = half * of_slope * inverse * inverse * inverse
            cot[OF_SHAPE + i] = half * of_sag * inverse * (q + e * sag * sag) + cubed
            cot[OF_SECOND + i] = half * c * (of_sag * inverse * sag * sag + c * c * q * cubed)
            cot[OF_A2 + i] = of_sag * q + of_slope
            # From here on: q^(j+1) and the weights of q^(j+2) and its derivative.
            w[LOWER + i], w[OF_SLOPE + i] = q, of_slope
        for j in range(count):
            out = carray(shifted(cotangents, OF_COEFFICIENTS + BLOCK * j), BLOCK)
            power = real(j + 2)
            for i in range(BLOCK):
                q, lower = w[Q + i], w[LOWER + i]
                upper = lower * q
                out[i] = w[OF_SAG + i] * upper + power * w[OF_SLOPE + i] * lower
                w[LOWER + i] = upper

    return kernel


KERNELS = given_by_sag(
    even_asphere_sag, even_asphere_hessian, even_asphere_parameters, starts_on_conic=True
)
