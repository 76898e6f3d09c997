"""An XY phase φ = m·Σ a_ij·u^i·v^j with u = x/R, v = y/R.

Numbers: m, R, then all coefficients of u, v, u², uv, v², u³, ... up to the highest degree.  That of
u^i·v^j has the number d(d+1)/2 + j among them, counted from 1, with d = i + j.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import given_by_phase
from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    LENGTH,
    NUMBERS,
    OF_PHASE,
    OF_PHASE_X,
    OF_PHASE_Y,
    OF_RECORD,
    OWN_OF_PHASE,
    PHASE,
    PHASE_X,
    PHASE_XX,
    PHASE_XY,
    PHASE_Y,
    PHASE_YY,
    POINT_X,
    POINT_Y,
    UNBOUNDED,
    WORK_SIZE,
)

# Rows of u and v; of a row of the polynomial and its derivatives; of the cotangents: powers.
U, V, ROW, ROW_U, ROW_UU, _ = OWN_OF_PHASE
POWER_U, LOWER_U, POWER_V, LOWER_V = ROW, ROW_U, ROW_UU, OWN_OF_PHASE[5]


@cache
def _shared(real: types.Type) -> tuple[Any, Any]:
    """Compile the degree of a polynomial, and the scaled points of a block."""

    @njit(**OPTIONS)
    def degree_of(codes):  # noqa: ANN001, ANN202
        terms = codes[LENGTH] - codes[NUMBERS] - 2
        degree = 0
        while degree * (degree + 3) // 2 < terms:
            degree += 1
        return degree

    @njit(**OPTIONS)
    def scale_points(w, inverse):  # noqa: ANN001, ANN202
        for i in range(BLOCK):
            w[U + i], w[V + i] = inverse * w[POINT_X + i], inverse * w[POINT_Y + i]

    return degree_of, scale_points


def _horner(real: types.Type, second: bool) -> Callable[..., None]:
    """Fill phase and gradient, and second derivatives, by Horner's rule in u within one in v."""
    degree_of, scale_points = _shared(real)
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q[NUMBERS]), UNBOUNDED)
        order, inverse = p[0], one / p[1]
        scale_points(w, inverse)
        degree = degree_of(q)
        for i in range(BLOCK):
            w[PHASE + i], w[PHASE_X + i], w[PHASE_Y + i] = zero, zero, zero
            w[PHASE_XX + i], w[PHASE_XY + i], w[PHASE_YY + i] = zero, zero, zero
        for j in range(degree, -1, -1):
            for i in range(BLOCK):
                w[ROW + i], w[ROW_U + i], w[ROW_UU + i] = zero, zero, zero
            for k in range(degree - j, -1, -1):
                total = k + j
                a = p[1 + total * (total + 1) // 2 + j] if total > 0 else zero
                for i in range(BLOCK):
                    u, row, slope = w[U + i], w[ROW + i], w[ROW_U + i]
                    if second:
                        w[ROW_UU + i] = w[ROW_UU + i] * u + slope
                    w[ROW_U + i] = slope * u + row
                    w[ROW + i] = row * u + a
            for i in range(BLOCK):
                v, phase, of_u, of_v = w[V + i], w[PHASE + i], w[PHASE_X + i], w[PHASE_Y + i]
                if second:
                    # Half of ∂²φ/∂v² and of ∂²φ/∂u².
                    w[PHASE_YY + i] = w[PHASE_YY + i] * v + of_v
                    w[PHASE_XY + i] = w[PHASE_XY + i] * v + of_u
                    w[PHASE_XX + i] = w[PHASE_XX + i] * v + w[ROW_UU + i]
                w[PHASE_Y + i] = of_v * v + phase
                w[PHASE_X + i] = of_u * v + w[ROW_U + i]
                w[PHASE + i] = phase * v + w[ROW + i]
        slope = order * inverse
        curvature = slope * inverse
        for i in range(BLOCK):
            w[PHASE + i] *= order
            w[PHASE_X + i] *= slope
            w[PHASE_Y + i] *= slope
            if second:
                w[PHASE_XX + i] *= two * curvature
                w[PHASE_XY + i] *= curvature
                w[PHASE_YY + i] *= two * curvature

    return kernel


def xy_phase(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase and gradient."""
    return _horner(real, False)


def xy_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase, gradient and second derivatives."""
    return _horner(real, True)


def xy_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the coefficients; order and radius are no variables."""
    degree_of, scale_points = _shared(real)
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q[NUMBERS]), 2)
        order, inverse = p[0], one / p[1]
        slope = order * inverse
        scale_points(w, inverse)
        degree = degree_of(q)
        first = OF_RECORD + BLOCK * q[NUMBERS]
        out = carray(shifted(cotangents, first), 2 * BLOCK)
        for i in range(BLOCK):
            out[i], out[BLOCK + i] = zero, zero
            w[POWER_V + i], w[LOWER_V + i] = one, zero
        # u^k·v^j with k and j growing, each with its next lower power.
        for j in range(degree + 1):
            for i in range(BLOCK):
                w[POWER_U + i], w[LOWER_U + i] = one, zero
            for k in range(degree + 1 - j):
                total = k + j
                if total > 0:
                    place = first + BLOCK * (1 + total * (total + 1) // 2 + j)
                    of_a = carray(shifted(cotangents, place), BLOCK)
                    times_k, times_j = real(k) * slope, real(j) * slope
                    for i in range(BLOCK):
                        power_u, power_v = w[POWER_U + i], w[POWER_V + i]
                        of_a[i] = (
                            order * w[OF_PHASE + i] * power_u * power_v
                            + times_k * w[OF_PHASE_X + i] * w[LOWER_U + i] * power_v
                            + times_j * w[OF_PHASE_Y + i] * power_u * w[LOWER_V + i]
                        )
                for i in range(BLOCK):
                    w[LOWER_U + i] = w[POWER_U + i]
                    w[POWER_U + i] *= w[U + i]
            for i in range(BLOCK):
                w[LOWER_V + i] = w[POWER_V + i]
                w[POWER_V + i] *= w[V + i]

    return kernel


KERNELS = given_by_phase(xy_phase, xy_hessian, xy_parameters)
