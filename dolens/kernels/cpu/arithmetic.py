"""Arithmetic of one ray at any surface: clamps, transfer, refraction, and deflection by a phase.

Adjoints stand beside.  They mirror `dolens.optics.trace` and `dolens.optics.surfaces.refraction`.

A phase deflects rays where they stand on a surface; see `dolens.optics.surfaces.phase`.

The surface gives the normal by its block functions `sag` and `sag_hessian`, and the phase gives φ,
its gradient and its second derivatives by its own, all by address in the codes.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, Factory, LawFunctions, call_block
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    ENDED,
    INVERSE_INDEX,
    MISSED,
    OF_BEHIND,
    OF_FRONT,
    OF_PHASE,
    OF_PHASE_X,
    OF_PHASE_Y,
    OF_SAG,
    OF_SHIFT,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    PARAMETERS,
    PATH,
    PER_RADIAN,
    PHASE,
    PHASE_AND_SLOPES,
    PHASE_HESSIAN,
    PHASE_PARAMETERS,
    PHASE_X,
    PHASE_XX,
    PHASE_XY,
    PHASE_Y,
    PHASE_YY,
    POINT_X,
    POINT_Y,
    RATIO,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SENSE_BEHIND,
    SHORT_RECORD,
    SLOPE_X,
    SLOPE_Y,
    STATE,
    STOPPED,
    TAG,
    TOTALLY_REFLECTED,
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
from dolens.kernels.limits import GRAZING, LONGEST, LONGEST_WAVEVECTOR, STEEPEST, TINY


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
    grazing, tiny = real(GRAZING), real(TINY)
    zero, one, longest = real(0.0), real(1.0), real(LONGEST)
    stopped, totally_reflected = real(STOPPED), real(TOTALLY_REFLECTED)
    missed = real(MISSED)

    @njit(**OPTIONS)
    def clamp(value, limit):  # noqa: ANN001, ANN202
        """Return the value, held within ± limit; NaN stays."""
        low = -limit
        value = low if value < low else value
        return limit if value > limit else value

    @njit(**OPTIONS)
    def safe_sqrt(squared):  # noqa: ANN001, ANN202
        """Return the square root; an argument that is not positive counts as 1e-18."""
        return math.sqrt(squared if squared > tiny else tiny)

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

    @njit(**OPTIONS)
    def refract(l, m, n, nx, ny, nz, ratio, sense):  # noqa: ANN001, ANN202, E741
        """Return direction and cos² of the angle behind a surface; it is positive without TIR."""
        cosine = clamp(l * nx + m * ny + n * nz, longest)
        squared = (one - ratio * ratio) + (ratio * ratio) * (cosine * cosine)
        along = sense * safe_sqrt(squared) - ratio * cosine
        return (
            clamp(ratio * l + along * nx, longest),
            clamp(ratio * m + along * ny, longest),
            clamp(ratio * n + along * nz, longest),
            squared,
        )

    @njit(**OPTIONS)
    def refract_adjoint(a, b, c, l, m, n, nx, ny, nz, out_l, out_m, out_n, ratio, per_index):  # noqa: ANN001, ANN202, E741
        """Return the cotangents of direction, normal and both indices from (a, b, c), that of d',
        and 1/cos i.

        d' = μ·d + Γ·N with Γ = s·cos t - μ·cos i, and s·cos t = d'·N.  `per_index` is one over the
        index in front.  One division serves both cosines.
        """
        cosine = l * nx + m * ny + n * nz
        inside = out_l * nx + out_m * ny + out_n * nz
        both = one / (cosine * inside)
        along = inside - ratio * cosine
        of_along = a * nx + b * ny + c * nz
        refracted = ratio * both * cosine
        of_cosine = of_along * (ratio * refracted * cosine - ratio)
        of_ratio = (a * l + b * m + c * n) - of_along * (
            refracted * (one - cosine * cosine) + cosine
        )
        of_before = of_ratio * ratio * per_index
        return (
            ratio * a + of_cosine * nx,
            ratio * b + of_cosine * ny,
            ratio * c + of_cosine * nz,
            along * a + of_cosine * l,
            along * b + of_cosine * m,
            along * c + of_cosine * n,
            of_before,
            -of_before * ratio,
            both * inside,
        )

    return Arithmetic(clamp, safe_sqrt, arrive, set_status, refract, refract_adjoint)


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
