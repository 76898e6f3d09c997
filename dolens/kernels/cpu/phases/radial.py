"""A radial phase φ = m·q·h(q) with q = (r/R)², h = p2 + p4·q + ...; numbers: m, R, p2, p4, ..."""

from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import given_by_phase
from dolens.kernels.cpu.compiler import shifted
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

# Rows of q, h, h' and h''/2; of the cotangents: powers of q, and the weight of the slope.
Q, H, SLOPE, SECOND, *_ = OWN_OF_PHASE


def radial_phase(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase and gradient by Horner's rule: φ' = m(h + q·h')."""
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q_ = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q_[NUMBERS]), UNBOUNDED)
        order, inverse = p[0], one / p[1]
        for i in range(BLOCK):
            u, v = inverse * w[POINT_X + i], inverse * w[POINT_Y + i]
            w[Q + i] = u * u + v * v
            w[H + i], w[SLOPE + i] = zero, zero
        for j in range(q_[LENGTH] - q_[NUMBERS] - 1, 1, -1):
            a = p[j]
            for i in range(BLOCK):
                q, h = w[Q + i], w[H + i]
                w[SLOPE + i] = w[SLOPE + i] * q + h
                w[H + i] = h * q + a
        twice = two * order * inverse * inverse
        for i in range(BLOCK):
            q, h = w[Q + i], w[H + i]
            slope = twice * (h + q * w[SLOPE + i])
            w[PHASE + i] = order * (q * h)
            w[PHASE_X + i], w[PHASE_Y + i] = slope * w[POINT_X + i], slope * w[POINT_Y + i]

    return kernel


def radial_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of phase, gradient and second derivatives: φ'' = m(2h' + q·h'')."""
    zero, one, two, four = real(0.0), real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q_ = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q_[NUMBERS]), UNBOUNDED)
        order, inverse = p[0], one / p[1]
        for i in range(BLOCK):
            u, v = inverse * w[POINT_X + i], inverse * w[POINT_Y + i]
            w[Q + i] = u * u + v * v
            w[H + i], w[SLOPE + i], w[SECOND + i] = zero, zero, zero
        for j in range(q_[LENGTH] - q_[NUMBERS] - 1, 1, -1):
            a = p[j]
            for i in range(BLOCK):
                q, h, d = w[Q + i], w[H + i], w[SLOPE + i]
                w[SECOND + i] = w[SECOND + i] * q + d
                w[SLOPE + i] = d * q + h
                w[H + i] = h * q + a
        squared = inverse * inverse
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            q, h, d = w[Q + i], w[H + i], w[SLOPE + i]
            slope = two * order * squared * (h + q * d)
            second = four * order * squared * squared * (two * d + two * q * w[SECOND + i])
            w[PHASE + i] = order * (q * h)
            w[PHASE_X + i], w[PHASE_Y + i] = slope * x, slope * y
            w[PHASE_XX + i] = slope + second * x * x
            w[PHASE_XY + i] = second * x * y
            w[PHASE_YY + i] = slope + second * y * y

    return kernel


def radial_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of p2, p4, ...; order and radius are no variables.

    ∂φ/∂p = m·q^k and ∂φ_x/∂p = m·k·q^(k-1)·2x/R² for the k-th.
    """
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q_ = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q_[NUMBERS]), 2)
        order, inverse = p[0], one / p[1]
        first = OF_RECORD + BLOCK * q_[NUMBERS]
        out = carray(shifted(cotangents, first), 2 * BLOCK)
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            u, v = inverse * x, inverse * y
            w[Q + i] = u * u + v * v
            w[H + i] = order
            w[SLOPE + i] = two * inverse * inverse * (
                x * w[OF_PHASE_X + i] + y * w[OF_PHASE_Y + i]
            )  # fmt: skip
            out[i], out[BLOCK + i] = zero, zero
        for j in range(2, q_[LENGTH] - q_[NUMBERS]):
            of_p = carray(shifted(cotangents, first + BLOCK * j), BLOCK)
            power = real(j - 1)
            for i in range(BLOCK):
                lower = w[H + i]
                upper = lower * w[Q + i]
                of_p[i] = w[OF_PHASE + i] * upper + power * w[SLOPE + i] * lower
                w[H + i] = upper

    return kernel


KERNELS = given_by_phase(radial_phase, radial_hessian, radial_parameters)
