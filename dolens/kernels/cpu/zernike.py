"""Zernike polynomials on an even asphere; see `dolens.optics.surfaces.zernike`.

The record holds the even asphere's numbers, the normalisation radius, the decentre, and the
coefficients.  Extras say which coefficient belongs to which term.  With w = u + i·v the terms of
azimuthal order m add up to Re(w^m)·A(q) + Im(w^m)·B(q), q = u² + v².
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu import jacobi as polynomials
from dolens.kernels.cpu.compiler import OPTIONS, call_block, int64_at, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.jacobi import jacobi
from dolens.kernels.cpu.layout import (
    ASPHERE_HESSIAN,
    ASPHERE_PARAMETERS,
    ASPHERE_SAG,
    BEHIND_ASPHERE,
    BLOCK,
    CODE_ROW,
    COUNT,
    DEGREE,
    EXTRAS_ADDRESS,
    FURTHER,
    OF_BEHIND_ASPHERE,
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
)

CONSTANTS = 3  # normalisation radius and decentre, before the coefficients
# Work rows: u, v and q; w^m, w^(m-1) and w^(m-2); A and B with two derivatives; the recurrence.
ROWS = 15 + polynomials.ROWS
U, V, QUADRANCE, C, S, C_1, S_1, C_2, S_2, A, A_1, A_2, B, B_1, B_2 = (
    FURTHER + BLOCK * row for row in range(15)
)
RECURRENCE = FURTHER + 15 * BLOCK
VALUE, SLOPE, SECOND = (
    RECURRENCE + row for row in (polynomials.VALUE, polynomials.SLOPE, polynomials.SECOND)
)


@cache
def _parts(real: types.Type) -> tuple[Any, Any, Any, Any]:
    """Compile the beginning, the step to the next azimuthal order, the sums A and B, and norms."""
    zero, one = real(0.0), real(1.0)
    recurrence, begin_polynomials, advance = jacobi(real)

    @njit(**OPTIONS)
    def begin(w, own):  # noqa: ANN001, ANN202
        """Fill u, v, q and w⁰ = 1; return one over the normalisation radius."""
        scale = one / own[0]
        for i in range(BLOCK):
            u, v = (w[POINT_X + i] - own[1]) * scale, (w[POINT_Y + i] - own[2]) * scale
            w[U + i], w[V + i], w[QUADRANCE + i] = u, v, u * u + v * v
            w[C + i], w[S + i] = one, zero
            w[C_1 + i], w[S_1 + i], w[C_2 + i], w[S_2 + i] = zero, zero, zero, zero
        return scale

    @njit(**OPTIONS)
    def next_order(w):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            u, v, c, s = w[U + i], w[V + i], w[C + i], w[S + i]
            w[C_2 + i], w[S_2 + i], w[C_1 + i], w[S_1 + i] = w[C_1 + i], w[S_1 + i], c, s
            w[C + i], w[S + i] = c * u - s * v, s * u + c * v

    @njit(**OPTIONS)
    def norm(normalised, k, m):  # noqa: ANN001, ANN202
        """Return √(n+1), times √2 for m > 0, or one."""
        if normalised == 0:
            return one
        return math.sqrt(real((2 * k + m + 1) * (2 if m > 0 else 1)))

    @njit(**OPTIONS)
    def sums(w, work, own, extras, place, m, count):  # noqa: ANN001, ANN202
        """Fill A and B and their derivatives of order m from `count` radial orders."""
        rows = shifted(work, RECURRENCE)
        begin_polynomials(rows)
        for i in range(BLOCK):
            w[A + i], w[A_1 + i], w[A_2 + i] = zero, zero, zero
            w[B + i], w[B_1 + i], w[B_2 + i] = zero, zero, zero
        for k in range(count):
            if k > 0:
                a, b, c = recurrence(k, m)
                advance(rows, shifted(work, QUADRANCE), a, b, c)
            cosine, sine = extras[place + 2 * k], extras[place + 2 * k + 1]
            factor = norm(extras[0], k, m)
            if cosine >= 0:
                a = factor * own[CONSTANTS + cosine]
                for i in range(BLOCK):
                    w[A + i] += a * w[VALUE + i]
                    w[A_1 + i] += a * w[SLOPE + i]
                    w[A_2 + i] += a * w[SECOND + i]
            if sine >= 0:
                a = factor * own[CONSTANTS + sine]
                for i in range(BLOCK):
                    w[B + i] += a * w[VALUE + i]
                    w[B_1 + i] += a * w[SLOPE + i]
                    w[B_2 + i] += a * w[SECOND + i]

    return begin, next_order, sums, norm


def zernike_sag(real: types.Type) -> Callable[..., None]:
    """Add the polynomials to the rows of sag and slopes."""
    begin, next_order, sums, _ = _parts(real)
    two = real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(q[ASPHERE_SAG], before, after, cotangents, record, work, codes)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        own = carray(shifted(record, BEHIND_ASPHERE + q[COUNT]), UNBOUNDED)
        scale = begin(w, own)
        place = 1
        for m in range(q[DEGREE] + 1):
            if m > 0:
                next_order(w)
            count = extras[place]
            if count > 0:
                sums(w, work, own, extras, place + 1, m, count)
                order = real(m)
                for i in range(BLOCK):
                    a, b, c, s = w[A + i], w[B + i], w[C + i], w[S + i]
                    radial = two * (c * w[A_1 + i] + s * w[B_1 + i])
                    along = order * (w[C_1 + i] * a + w[S_1 + i] * b) + w[U + i] * radial
                    across = order * (w[C_1 + i] * b - w[S_1 + i] * a) + w[V + i] * radial
                    w[SAG + i] += c * a + s * b
                    w[SLOPE_X + i] += along * scale
                    w[SLOPE_Y + i] += across * scale
            place += 1 + 2 * count

    return kernel


def zernike_hessian(real: types.Type) -> Callable[..., None]:
    """Add the polynomials to the rows of slopes and second derivatives.

    With E = C·A + S·B, and G1 and G2 the same with w^(m-1) and w^(m-2):
    s_uu = m(m-1)·G2 + 4u·m·G1' + 2E' + 4u²·E''.
    """
    begin, next_order, sums, _ = _parts(real)
    two, four = real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(q[ASPHERE_HESSIAN], before, after, cotangents, record, work, codes)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        own = carray(shifted(record, BEHIND_ASPHERE + q[COUNT]), UNBOUNDED)
        scale = begin(w, own)
        squared = scale * scale
        place = 1
        for m in range(q[DEGREE] + 1):
            if m > 0:
                next_order(w)
            count = extras[place]
            if count > 0:
                sums(w, work, own, extras, place + 1, m, count)
                order, pairs = real(m), real(m * (m - 1))
                for i in range(BLOCK):
                    u, v, c, s = w[U + i], w[V + i], w[C + i], w[S + i]
                    a, b, da, db = w[A + i], w[B + i], w[A_1 + i], w[B_1 + i]
                    c1, s1, c2, s2 = w[C_1 + i], w[S_1 + i], w[C_2 + i], w[S_2 + i]
                    e1 = two * (c * da + s * db)
                    e2 = four * (c * w[A_2 + i] + s * w[B_2 + i])
                    g, h = order * (c1 * a + s1 * b), order * (c1 * b - s1 * a)
                    g1, h1 = two * order * (c1 * da + s1 * db), two * order * (c1 * db - s1 * da)
                    g2, h2 = pairs * (c2 * a + s2 * b), pairs * (c2 * b - s2 * a)
                    w[SLOPE_X + i] += (g + u * e1) * scale
                    w[SLOPE_Y + i] += (h + v * e1) * scale
                    w[SAG_XX + i] += (g2 + two * u * g1 + e1 + u * u * e2) * squared
                    w[SAG_XY + i] += (h2 + u * h1 + v * g1 + u * v * e2) * squared
                    w[SAG_YY + i] += (e1 - g2 + two * v * h1 + v * v * e2) * squared
            place += 1 + 2 * count

    return kernel


def zernike_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the even asphere's numbers and of the coefficients.

    Of Re(w^m)·P(q): of_sag·C·P + of_u·(m·C_1·P + 2u·C·P') + of_v·(-m·S_1·P + 2v·C·P').
    """
    begin, next_order, _, norm = _parts(real)
    recurrence, begin_polynomials, advance = jacobi(real)
    zero, two = real(0.0), real(2.0)

    @njit(**OPTIONS)
    def write(w, out, factor, of_value, of_slope):  # noqa: ANN001, ANN202
        row = carray(out, BLOCK)
        for i in range(BLOCK):
            value, slope = w[VALUE + i], w[SLOPE + i]
            row[i] = factor * (w[of_value + i] * value + w[of_slope + i] * slope)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(q[ASPHERE_PARAMETERS], before, after, cotangents, record, work, codes)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        own = carray(shifted(record, BEHIND_ASPHERE + q[COUNT]), UNBOUNDED)
        out = shifted(cotangents, OF_BEHIND_ASPHERE + BLOCK * q[COUNT])
        constants = carray(out, CONSTANTS * BLOCK)
        for i in range(CONSTANTS * BLOCK):
            constants[i] = zero
        scale = begin(w, own)
        rows = shifted(work, RECURRENCE)
        place = 1
        for m in range(q[DEGREE] + 1):
            if m > 0:
                next_order(w)
            count = extras[place]
            order = real(m)
            # Rows A and A_1 hold the weights of a cosine's P and P', B and B_1 those of a sine's.
            for i in range(BLOCK):
                of_sag = w[OF_SAG + i]
                of_u, of_v = w[OF_SLOPE_X + i] * scale, w[OF_SLOPE_Y + i] * scale
                along = two * (of_u * w[U + i] + of_v * w[V + i])
                c, s, c1, s1 = w[C + i], w[S + i], w[C_1 + i], w[S_1 + i]
                w[A + i] = of_sag * c + order * (of_u * c1 - of_v * s1)
                w[B + i] = of_sag * s + order * (of_u * s1 + of_v * c1)
                w[A_1 + i], w[B_1 + i] = along * c, along * s
            begin_polynomials(rows)
            for k in range(count):
                if k > 0:
                    a, b, c_k = recurrence(k, m)
                    advance(rows, shifted(work, QUADRANCE), a, b, c_k)
                factor = norm(extras[0], k, m)
                cosine, sine = extras[place + 1 + 2 * k], extras[place + 2 + 2 * k]
                if cosine >= 0:
                    write(w, shifted(out, BLOCK * (CONSTANTS + cosine)), factor, A, A_1)
                if sine >= 0:
                    write(w, shifted(out, BLOCK * (CONSTANTS + sine)), factor, B, B_1)
            place += 1 + 2 * count

    return kernel


def _rows(row: Sequence[int]) -> int:
    """Return the number of work rows of its own."""
    return ROWS


KERNELS = given_by_sag(
    zernike_sag,
    zernike_hessian,
    zernike_parameters,
    starts_on_conic=True,
    on_asphere=True,
    scratch=_rows,
)
