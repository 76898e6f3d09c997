"""An ideal lens deflects rays on its plane; see `dolens.optics.surfaces.ideal_lens`.

Numbers: the power φ, and the reduced vergence V of the light that arrives.
"""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.compiler import LawFunctions, shifted
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    ENDED,
    INDEX,
    INVERSE_INDEX,
    NUMBERS,
    OF_BEHIND,
    OF_FRONT,
    OF_RECORD,
    OF_SHIFT,
    PATH,
    RATIO,
    SENSE,
    SHAPE,
    SHORT_RECORD,
    STATE,
    TRAVELLED,
    UNBOUNDED,
    VIGNETTED,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.limits import GRAZING


def ideal_lens_forward(real: types.Type) -> Callable[..., None]:
    """Change slopes and paths of a block of rays on the lens."""
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q_ = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = carray(shifted(record, q_[NUMBERS]), 2)
        sense, power, vergence = carray(record, SHORT_RECORD)[SENSE], p[0], p[1]
        for i in range(BLOCK):
            ratio, front, inverse = w[RATIO + i], w[INDEX + i], w[INVERSE_INDEX + i]
            bend, turn = power * ratio * inverse, vergence * inverse
            x, y, cosine = src[X + i], src[Y + i], math.fabs(src[N + i])
            q = one / (cosine if cosine > grazing else grazing)
            ux, uy = src[L + i] * q, src[M + i] * q
            vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
            q2 = math.sqrt(one + vx * vx + vy * vy)
            wx, wy = ux - x * turn, uy - y * turn
            across = wx * wx + wy * wy
            arrived = (x * (ux + wx) + y * (uy + wy)) / (math.sqrt(one + across) + q)
            left = (x * (vx + ratio * wx) + y * (vy + ratio * wy)) / (
                math.sqrt(one + ratio * ratio * across) + q2
            )
            cosine = one / q2
            dst[X + i], dst[Y + i], dst[Z + i] = x, y, src[Z + i]
            dst[L + i], dst[M + i], dst[N + i] = vx * cosine, vy * cosine, sense * cosine
            dst[PATH + i] = src[PATH + i] + front * (left / ratio - arrived)
            dst[ENDED + i], dst[VIGNETTED + i] = src[ENDED + i], src[VIGNETTED + i]
            dst[TRAVELLED + i] = zero

    return kernel


def ideal_lens_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through the lens, in place: the chain rule, line by line from the last
    line of `ideal_lens_forward`.
    """
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src = carray(before, STATE)
        w, q_ = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        p = carray(shifted(record, q_[NUMBERS]), 2)
        sense, power, vergence = carray(record, SHORT_RECORD)[SENSE], p[0], p[1]
        out = carray(shifted(cotangents, OF_RECORD + BLOCK * q_[NUMBERS]), 2 * BLOCK)
        for i in range(BLOCK):
            ratio, front, inverse = w[RATIO + i], w[INDEX + i], w[INVERSE_INDEX + i]
            per_behind = ratio * inverse
            behind, bend, turn = front / ratio, power * per_behind, vergence * inverse
            x, y = src[X + i], src[Y + i]
            q = one / math.fabs(src[N + i])
            ux, uy = src[L + i] * q, src[M + i] * q
            vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
            q2 = math.sqrt(one + vx * vx + vy * vy)
            wx, wy = ux - x * turn, uy - y * turn
            across = wx * wx + wy * wy
            q0, q02 = math.sqrt(one + across), math.sqrt(one + ratio * ratio * across)
            first, second = one / (q0 + q), one / (q02 + q2)
            arrived = (x * (ux + wx) + y * (uy + wy)) * first
            left = (x * (vx + ratio * wx) + y * (vy + ratio * wy)) * second

            a, b, c, path = cot[L + i], cot[M + i], cot[N + i], cot[PATH + i]
            cosine = one / q2
            of_q2 = -(a * vx + b * vy + c * sense) * cosine * cosine
            of_vx, of_vy = a * cosine, b * cosine
            of_front, of_behind = -path * arrived, path * left
            of_s1, of_s2 = -path * front * first, path * behind * second
            of_q, of_q2 = -of_s1 * arrived, of_q2 - of_s2 * left
            # Twice the cotangent of w².
            of_across = of_q / q0 - of_s2 * left * ratio * ratio / q02
            of_x = of_s1 * (ux + wx) + of_s2 * (vx + ratio * wx)
            of_y = of_s1 * (uy + wy) + of_s2 * (vy + ratio * wy)
            of_ux, of_uy = of_s1 * x, of_s1 * y
            of_wx = (of_s1 + of_s2 * ratio) * x + of_across * wx
            of_wy = (of_s1 + of_s2 * ratio) * y + of_across * wy
            of_ratio = of_s2 * (x * wx + y * wy) - of_s2 * left * ratio * across / q02
            of_vx += of_s2 * x + of_q2 * vx * cosine
            of_vy += of_s2 * y + of_q2 * vy * cosine
            # w = u - r·V/n.
            of_turn = -(x * of_wx + y * of_wy)
            of_x, of_y = of_x - turn * of_wx, of_y - turn * of_wy
            of_ux, of_uy = of_ux + of_wx, of_uy + of_wy
            # u' = μ·u - r·φ/n'.
            of_bend = -(x * of_vx + y * of_vy)
            of_ratio += ux * of_vx + uy * of_vy
            of_x, of_y = of_x - bend * of_vx, of_y - bend * of_vy
            of_ux, of_uy = of_ux + ratio * of_vx, of_uy + ratio * of_vy
            of_q += src[L + i] * of_ux + src[M + i] * of_uy

            out[i], out[BLOCK + i] = of_bend * per_behind, of_turn * inverse
            of_front += (of_ratio * ratio - of_turn * turn) * inverse
            of_behind -= (of_ratio * ratio + of_bend * bend) * per_behind
            cot[X + i] += of_x
            cot[Y + i] += of_y
            cot[L + i], cot[M + i] = of_ux * q, of_uy * q
            cot[N + i] = -of_q * q * q * sense
            cot[OF_FRONT + i], cot[OF_BEHIND + i] = of_front, of_behind
            cot[OF_SHIFT + i] = zero
        for j in range(SHAPE, q_[NUMBERS]):
            of_shape = carray(shifted(cotangents, OF_RECORD + BLOCK * j), BLOCK)
            for i in range(BLOCK):
                of_shape[i] = zero

    return kernel


KERNELS = LawFunctions(ideal_lens_forward, ideal_lens_adjoint)
