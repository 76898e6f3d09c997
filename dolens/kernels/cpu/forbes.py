"""Forbes's Q_con and Q_bfs on a conic; see `dolens.optics.surfaces.forbes`.

The record holds c, k, a2 (zero), the normalisation radius, and the coefficients b of polynomials
with a three-term recurrence: the Jacobi polynomials P^(0, 4) of Q_con (degree 0 in the codes), or
the auxiliary polynomials of Q_bfs (degree 1).  With q = r²/R² and T = Σ b·P(q) the departure is
D = q²·T, or D = E·σ with E = q(1 - q)·T and σ = √(a/b), a = 1 - k·κ·q and b = a - κ·q, κ = c²R²:
the secant of the conic's normal, σ' = σ·κ/(2ab).
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu import jacobi as polynomials
from dolens.kernels.cpu.compiler import OPTIONS, call_block, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.jacobi import jacobi
from dolens.kernels.cpu.layout import (
    ASPHERE_HESSIAN,
    ASPHERE_PARAMETERS,
    ASPHERE_SAG,
    BEHIND_ASPHERE,
    BLOCK,
    CODE_ROW,
    COLUMNS,
    DEGREE,
    FURTHER,
    MARGIN,
    OF_BEHIND_ASPHERE,
    OF_SAG,
    OF_SECOND,
    OF_SHAPE,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SHAPE,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
)

# Work rows: q; T with two derivatives; the recurrence.
ROWS = 4 + polynomials.ROWS
QUADRANCE, T, T_1, T_2 = (FURTHER + BLOCK * row for row in range(4))
RECURRENCE = FURTHER + 4 * BLOCK
VALUE, SLOPE, SECOND = (
    RECURRENCE + row for row in (polynomials.VALUE, polynomials.SLOPE, polynomials.SECOND)
)
STEEPEST = 1e-12  # as in the reference


@cache
def _parts(real: types.Type) -> tuple[Any, Any, Any, Any, Any]:
    """Compile the recurrence's coefficients, q, the sum T, the departure with derivatives, and the
    secant.
    """
    zero, half, one, two, three = real(0.0), real(0.5), real(1.0), real(2.0), real(3.0)
    four, steepest = real(4.0), real(STEEPEST)
    recurrence, begin_polynomials, advance = jacobi(real)

    @njit(**OPTIONS)
    def step(k, best_fit):  # noqa: ANN001, ANN202
        """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2)."""
        if best_fit == 0:
            return recurrence(k, 4)
        return -four, three if k == 1 else two, zero if k == 1 else one

    @njit(**OPTIONS)
    def begin(w, scale):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            w[QUADRANCE + i] = (x * x + y * y) * scale

    @njit(**OPTIONS)
    def total(w, work, own, count, best_fit):  # noqa: ANN001, ANN202
        rows = shifted(work, RECURRENCE)
        begin_polynomials(rows)
        for i in range(BLOCK):
            w[T + i], w[T_1 + i], w[T_2 + i] = zero, zero, zero
        for k in range(count):
            if k > 0:
                a, b, c = step(k, best_fit)
                advance(rows, shifted(work, QUADRANCE), a, b, c)
            a = own[1 + k]
            for i in range(BLOCK):
                w[T + i] += a * w[VALUE + i]
                w[T_1 + i] += a * w[SLOPE + i]
                w[T_2 + i] += a * w[SECOND + i]

    @njit(**OPTIONS)
    def secant_of(q, k, kappa):  # noqa: ANN001, ANN202
        """Return a, b and σ; beyond the branch b is held."""
        b = one - (one + k) * kappa * q
        b = b if b > steepest else steepest
        a = b + kappa * q
        return a, b, math.sqrt(a / b)

    @njit(**OPTIONS)
    def departure(q, t, t1, t2, k, kappa, best_fit):  # noqa: ANN001, ANN202
        """Return D and its derivatives in q, and E and E'."""
        if best_fit == 0:
            e, e1 = q * q * t, q * (two * t + q * t1)
            return e, e1, two * t + q * (four * t1 + q * t2), e, e1
        e, e1 = q * (one - q) * t, (one - two * q) * t + q * (one - q) * t1
        e2 = two * ((one - two * q) * t1 - t) + q * (one - q) * t2
        a, b, secant = secant_of(q, k, kappa)
        inverse = one / (a * b)
        s1 = half * kappa * inverse
        s2 = s1 * (s1 + kappa * (k * b + (one + k) * a) * inverse)
        return (
            secant * e,
            secant * (e1 + e * s1),
            secant * (e2 + two * e1 * s1 + e * s2),
            e,
            e1,
        )

    return step, begin, total, departure, secant_of


def forbes_sag(real: types.Type) -> Callable[..., None]:
    """Add the departure to the rows of sag and slopes; the margin is that of the branch."""
    _, begin, total, departure, _ = _parts(real)
    one, two, steepest = real(1.0), real(2.0), real(STEEPEST)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, codes_row = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(codes_row[ASPHERE_SAG], before, after, cotangents, record, work, codes)
        best_fit = codes_row[DEGREE]
        own = carray(shifted(record, BEHIND_ASPHERE), UNBOUNDED)
        c, k_base = carray(record, UNBOUNDED)[SHAPE], carray(record, UNBOUNDED)[SHAPE + 1]
        scale = one / (own[0] * own[0])
        kappa = c * c * own[0] * own[0]
        begin(w, scale)
        total(w, work, own, codes_row[COLUMNS], best_fit)
        for i in range(BLOCK):
            d, d1, _, _, _ = departure(
                w[QUADRANCE + i], w[T + i], w[T_1 + i], w[T_2 + i], k_base, kappa, best_fit
            )
            slope = two * scale * d1
            w[SAG + i] += d
            w[SLOPE_X + i] += w[POINT_X + i] * slope
            w[SLOPE_Y + i] += w[POINT_Y + i] * slope
        if best_fit != 0:
            for i in range(BLOCK):
                w[MARGIN + i] -= steepest

    return kernel


def forbes_hessian(real: types.Type) -> Callable[..., None]:
    """Add the departure to the rows of slopes and second derivatives."""
    _, begin, total, departure, _ = _parts(real)
    one, two, four = real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, codes_row = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(codes_row[ASPHERE_HESSIAN], before, after, cotangents, record, work, codes)
        best_fit = codes_row[DEGREE]
        own = carray(shifted(record, BEHIND_ASPHERE), UNBOUNDED)
        c, k_base = carray(record, UNBOUNDED)[SHAPE], carray(record, UNBOUNDED)[SHAPE + 1]
        scale = one / (own[0] * own[0])
        kappa = c * c * own[0] * own[0]
        begin(w, scale)
        total(w, work, own, codes_row[COLUMNS], best_fit)
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            _, d1, d2, _, _ = departure(
                w[QUADRANCE + i], w[T + i], w[T_1 + i], w[T_2 + i], k_base, kappa, best_fit
            )
            slope, second = two * scale * d1, four * scale * scale * d2
            w[SLOPE_X + i] += x * slope
            w[SLOPE_Y + i] += y * slope
            w[SAG_XX + i] += slope + x * x * second
            w[SAG_XY + i] += x * y * second
            w[SAG_YY + i] += slope + y * y * second

    return kernel


def forbes_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the conic and of the coefficients; `forbes_hessian` has left T.

    Of b: the departure and its slope with P in T's place.  Of c and k, which turn the normal: with
    Λ = σ'/σ = κ/(2ab), σ_κ = σ·q/(2ab), σ_k = σ·κ²q²/(2ab), Λ_κ = (1 + κq·(k·b + (1+k)·a)/(ab))/
    (2ab) and Λ_k = κ²q·(a + b)/(2a²b²).
    """
    step, _, _, departure, secant_of = _parts(real)
    begin_polynomials, advance = jacobi(real)[1:]
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, codes_row = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(codes_row[ASPHERE_PARAMETERS], before, after, cotangents, record, work, codes)
        cot = carray(cotangents, UNBOUNDED)
        best_fit = codes_row[DEGREE]
        own = carray(shifted(record, BEHIND_ASPHERE), UNBOUNDED)
        c, k_base = carray(record, UNBOUNDED)[SHAPE], carray(record, UNBOUNDED)[SHAPE + 1]
        scale, square = one / (own[0] * own[0]), own[0] * own[0]
        kappa = c * c * square
        # From here on the row of T holds the weight of slopes.
        for i in range(BLOCK):
            q = w[QUADRANCE + i]
            _, _, _, e, e1 = departure(q, w[T + i], w[T_1 + i], w[T_2 + i], k_base, kappa, best_fit)
            along = w[OF_SLOPE_X + i] * w[POINT_X + i] + w[OF_SLOPE_Y + i] * w[POINT_Y + i]
            of_slope = two * scale * along
            w[T + i] = of_slope
            cot[OF_BEHIND_ASPHERE + i] = zero
            if best_fit != 0:
                a, b, secant = secant_of(q, k_base, kappa)
                inverse = one / (a * b)
                # Weights of σ and of σ'/σ = κ/(2ab), and their derivatives in κ and in k.
                of_secant = w[OF_SAG + i] * e + of_slope * (e1 + e * half * kappa * inverse)
                weight = of_slope * e
                mixed = kappa * q * inverse * (k_base * b + (one + k_base) * a)
                share = half * secant * inverse
                bent = kappa * kappa * q
                of_kappa = share * (of_secant * q + weight * (one + mixed))
                of_k = share * (of_secant * bent * q + weight * bent * (a + b) * inverse)
                cot[OF_SHAPE + i] += two * c * square * of_kappa
                cot[OF_SECOND + i] += of_k
        rows = shifted(work, RECURRENCE)
        begin_polynomials(rows)
        for k in range(codes_row[COLUMNS]):
            if k > 0:
                a, b, c_k = step(k, best_fit)
                advance(rows, shifted(work, QUADRANCE), a, b, c_k)
            out = carray(shifted(cotangents, OF_BEHIND_ASPHERE + BLOCK * (k + 1)), BLOCK)
            for i in range(BLOCK):
                d, d1, _, _, _ = departure(
                    w[QUADRANCE + i], w[VALUE + i], w[SLOPE + i], zero, k_base, kappa, best_fit
                )
                out[i] = w[OF_SAG + i] * d + w[T + i] * d1

    return kernel


def _rows(row: Sequence[int]) -> int:
    """Return the number of work rows of its own."""
    return ROWS


KERNELS = given_by_sag(
    forbes_sag,
    forbes_hessian,
    forbes_parameters,
    starts_on_conic=True,
    on_asphere=True,
    scratch=_rows,
)
