"""A phase deflects rays where they stand on a surface; see `dolens.optics.surfaces.phase`.

The surface gives the normal by its block functions `sag` and `sag_hessian`, and the phase gives φ,
its gradient and its second derivatives by its own, all by address in the codes.
"""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import Factory, call_block
from dolens.kernels.cpu.functions import LawFunctions
from dolens.kernels.cpu.layout import (
    BLOCK,
    ENDED,
    INVERSE_INDEX,
    OF_BEHIND,
    OF_FRONT,
    OF_PHASE,
    OF_PHASE_X,
    OF_PHASE_Y,
    OF_SAG,
    OF_SHIFT,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    PATH,
    PER_RADIAN,
    PHASE,
    PHASE_X,
    PHASE_XX,
    PHASE_XY,
    PHASE_Y,
    PHASE_YY,
    POINT_X,
    POINT_Y,
    RATIO,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SLOPE_X,
    SLOPE_Y,
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
from dolens.kernels.cpu.records import (
    CODE_ROW,
    PARAMETERS,
    PHASE_AND_SLOPES,
    PHASE_HESSIAN,
    PHASE_PARAMETERS,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    SENSE_BEHIND,
    SHORT_RECORD,
    TAG,
    TOTALLY_REFLECTED,
)
from dolens.kernels.limits import LONGEST, LONGEST_WAVEVECTOR, STEEPEST


def phase_forward(real: types.Type) -> Callable[..., None]:
    """Deflect a block of rays that stand on a surface; an evanescent order ends them."""
    clamp, safe_sqrt, *_ = arithmetic(real)
    zero, one = real(0.0), real(1.0)
    longest, steepest = real(LONGEST), real(STEEPEST)
    longest_wavevector = real(LONGEST_WAVEVECTOR)
    totally_reflected = real(TOTALLY_REFLECTED)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        sense, evanescent = p[SENSE_BEHIND], p[TAG] + totally_reflected
        for i in range(BLOCK):
            w[POINT_X + i] = src[X + i]
            w[POINT_Y + i] = src[Y + i]
        call_block(q[SAG_AND_SLOPES], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_AND_SLOPES], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            ratio, per_radian = w[RATIO + i], w[PER_RADIAN + i]
            scale = per_radian * ratio * w[INVERSE_INDEX + i]
            gx, gy = scale * w[PHASE_X + i], scale * w[PHASE_Y + i]
            bx, by, az = ratio * src[L + i], ratio * src[M + i], ratio * src[N + i]
            ax, ay = bx + gx, by + gy
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            nx, ny = -sx * nz, -sy * nz
            along = clamp(ax * nx + ay * ny + az * nz, longest_wavevector)
            more = gx * (ax + bx) + gy * (ay + by)
            squared = (one - ratio * ratio) - more + along * along
            squared = squared if math.fabs(gx) + math.fabs(gy) < steepest else -one
            change = sense * safe_sqrt(squared) - along
            dst[X + i], dst[Y + i], dst[Z + i] = src[X + i], src[Y + i], src[Z + i]
            dst[L + i] = clamp(ax + change * nx, longest)
            dst[M + i] = clamp(ay + change * ny, longest)
            dst[N + i] = clamp(az + change * nz, longest)
            dst[PATH + i] = src[PATH + i] + per_radian * w[PHASE + i]
            ended = src[ENDED + i]
            dst[ENDED + i] = ended if ended > zero or squared > zero else evanescent
            dst[VIGNETTED + i], dst[TRAVELLED + i] = src[VIGNETTED + i], zero

    return kernel


def phase_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a phase, in place.

    d' = a + Γ·N with a = μ·d + g, Γ = D - a·N and D = d'·N, where D² = 1 - μ² - g·(2μ·d + g) +
    (a·N)².  So with (ā, b̄, c̄) = d̄', Γ̄ = d̄'·N, e = Γ̄/D and t = d̄' + (e·(a·N) - Γ̄)·N the
    cotangents are d̄ = μ(t - e·g), ḡ = t - e·a, μ̄ = d·t - e(μ + g·d), N̄ = Γ·d̄' + (e·(a·N) - Γ̄)·a.
    """
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        for i in range(BLOCK):
            w[POINT_X + i] = src[X + i]
            w[POINT_Y + i] = src[Y + i]
        call_block(q[SAG_HESSIAN], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_HESSIAN], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            ratio, per_radian = w[RATIO + i], w[PER_RADIAN + i]
            per_index = ratio * w[INVERSE_INDEX + i]
            scale = per_radian * per_index
            gx, gy = scale * w[PHASE_X + i], scale * w[PHASE_Y + i]
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            ax, ay, az = ratio * l + gx, ratio * m + gy, ratio * n
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            nx, ny = -sx * nz, -sy * nz
            a, b, c = cot[L + i], cot[M + i], cot[N + i]
            inside = dst[L + i] * nx + dst[M + i] * ny + dst[N + i] * nz
            along = ax * nx + ay * ny + az * nz
            change = inside - along
            of_change = a * nx + b * ny + c * nz
            e = of_change / inside
            of_along = e * along - of_change
            tx, ty, tz = a + of_along * nx, b + of_along * ny, c + of_along * nz
            of_gx, of_gy = tx - e * ax, ty - e * ay
            of_ratio = (l * tx + m * ty + n * tz) - e * (ratio + gx * l + gy * m)
            vx, vy = change * a + of_along * ax, change * b + of_along * ay
            vz = change * c + of_along * az
            across = vx * nx + vy * ny + vz * nz
            of_sx, of_sy = -(vx - across * nx) * nz, -(vy - across * ny) * nz
            path = per_radian * cot[PATH + i]
            of_px, of_py = scale * of_gx, scale * of_gy
            cot[X + i] += (
                of_sx * w[SAG_XX + i] + of_sy * w[SAG_XY + i]
                + path * w[PHASE_X + i] + of_px * w[PHASE_XX + i] + of_py * w[PHASE_XY + i]
            )  # fmt: skip
            cot[Y + i] += (
                of_sx * w[SAG_XY + i] + of_sy * w[SAG_YY + i]
                + path * w[PHASE_Y + i] + of_px * w[PHASE_XY + i] + of_py * w[PHASE_YY + i]
            )  # fmt: skip
            cot[L + i], cot[M + i] = ratio * (tx - e * gx), ratio * (ty - e * gy)
            cot[N + i] = ratio * tz
            cot[OF_FRONT + i] = of_ratio * per_index
            cot[OF_BEHIND + i] = -(of_ratio * ratio + gx * of_gx + gy * of_gy) * per_index
            cot[OF_SHIFT + i] = zero
            w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i] = zero, of_sx, of_sy
            w[OF_PHASE + i], w[OF_PHASE_X + i], w[OF_PHASE_Y + i] = path, of_px, of_py
        call_block(q[PARAMETERS], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_PARAMETERS], before, after, cotangents, record, work, codes)

    return kernel


def given_by_phase(
    phase: Factory, phase_hessian: Factory, phase_parameters: Factory
) -> LawFunctions:
    """Return the functions of a law that is given by its phase.

    Args:
        phase: factory of the block function that fills the rows of phase and gradient.
        phase_hessian: of the one that fills these, and the rows of second derivatives.
        phase_parameters: of the one that fills the cotangents of the law's numbers, from
            `record[NUMBERS]` on, from those of phase and gradient.
    """
    return LawFunctions(phase_forward, phase_adjoint, phase, phase_hessian, phase_parameters)
