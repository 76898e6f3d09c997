"""Newton's iteration finds the ray intercept on a surface that is given by its sag.

A shape gives three block functions, by address in its codes: `sag` (sag, slopes, and the margin of
its branch at the points in two work rows), `sag_hessian` (slopes and second derivatives there), and
`parameters` (cotangents of its numbers from those of sag and slopes).

`dolens.kernels.cpu.shapes` makes them from a shape's functions of one point.
"""

import math
from collections.abc import Callable
from typing import Any

from numba import carray, types

from dolens.kernels.conic import conic_distance
from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import Factory, StepFunctions, call_block
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    DISTANCE,
    EDGE,
    ENDED,
    INDEX,
    INVERSE_INDEX,
    LIMIT,
    MARGIN,
    OF_ARRIVING,
    OF_BEHIND,
    OF_FRONT,
    OF_LEAVING,
    OF_SAG,
    OF_SHIFT,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    PARAMETERS,
    PATH,
    POINT_X,
    POINT_Y,
    RATIO,
    REFRACTS,
    SAG,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SCALE,
    SENSE,
    SENSE_BEHIND,
    SHAPE,
    SHIFT,
    SHORT_RECORD,
    SLOPE_X,
    SLOPE_Y,
    STARTS_ON_CONIC,
    STATE,
    STENCIL_IS_HERE,
    TAG,
    TRAVELLED,
    UNBOUNDED,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.table import GRAZING, LAST_STEPS, NEWTON_STEPS


def explicit_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to the surface and through it; see `Surface.intersect`.

    The iteration ends when no ray moves any more, or after `NEWTON_STEPS`; whether a ray has
    converged is read off its residual at the end.
    """
    clamp, _, arrive, set_status, refract, _ = arithmetic(real)
    distance = scalar(conic_distance, real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)
    epsilon = real(2.0**-23 if real is types.float32 else 2.0**-52)
    close, rounding = real(math.sqrt(float(epsilon))), real(64.0) * epsilon
    closest = real(float(epsilon) ** 0.875)
    uncertain = real(1e-2)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        shift, limit, scale, sense, tag = p[SHIFT], p[LIMIT], p[SCALE], p[SENSE], p[TAG]
        edge, behind = p[EDGE], p[SENSE_BEHIND]
        refracts = q[REFRACTS] != 0
        # The point on the vertex plane, and its margin, stay in the rows that they end in.
        for i in range(BLOCK):
            x, y, t, met = arrive(
                src[X + i], src[Y + i], src[Z + i] + shift,
                src[L + i], src[M + i], src[N + i], sense, limit,
            )  # fmt: skip
            dst[X + i], dst[Y + i], dst[Z + i], dst[TRAVELLED + i] = x, y, met, t
            w[DISTANCE + i] = zero
        w[STENCIL_IS_HERE] = zero
        if q[STARTS_ON_CONIC] != 0:
            c, k = p[SHAPE], p[SHAPE + 1]
            for i in range(BLOCK):
                n = src[N + i]
                t, squared = distance(
                    c, c + (c * k) * (n * n), dst[X + i], dst[Y + i],
                    src[L + i], src[M + i], n, sense,
                )  # fmt: skip
                w[DISTANCE + i] = clamp(t, limit) if squared > zero else zero
        moving = zero
        for begin in range(2 if q[STARTS_ON_CONIC] != 0 else 1):
            for _ in range(NEWTON_STEPS):
                for i in range(BLOCK):
                    t = w[DISTANCE + i]
                    w[POINT_X + i] = dst[X + i] + src[L + i] * t
                    w[POINT_Y + i] = dst[Y + i] + src[M + i] * t
                call_block(q[SAG_AND_SLOPES], before, after, cotangents, record, work, codes)
                moving = zero
                for i in range(BLOCK):
                    t, n = w[DISTANCE + i], src[N + i]
                    slope = src[L + i] * w[SLOPE_X + i] + src[M + i] * w[SLOPE_Y + i] - n
                    size = math.fabs(slope)
                    change = (w[SAG + i] - n * t) / math.copysign(
                        size if size > grazing else grazing, slope
                    )
                    change = clamp(change, scale)
                    t = t - change
                    w[DISTANCE + i] = t
                    # A ray that has ended already keeps no other waiting.
                    far = math.fabs(change) > close * (math.fabs(t) + scale)
                    moving += one if far and not src[ENDED + i] > zero else zero
                if moving == zero:
                    break
            for i in range(BLOCK):
                t = w[DISTANCE + i]
                w[POINT_X + i] = dst[X + i] + src[L + i] * t
                w[POINT_Y + i] = dst[Y + i] + src[M + i] * t
            call_block(q[SAG_AND_SLOPES], before, after, cotangents, record, work, codes)
            if begin == 1 or q[STARTS_ON_CONIC] == 0:
                break
            # Rays that end at no root that counts begin once more, on the vertex plane.
            again = zero
            for i in range(BLOCK):
                t, n = w[DISTANCE + i], src[N + i]
                slope = src[L + i] * w[SLOPE_X + i] + src[M + i] * w[SLOPE_Y + i] - n
                off, reach = (
                    math.fabs(w[SAG + i] - n * t),
                    math.fabs(slope) * (math.fabs(t) + scale),
                )
                counts = sense * slope < zero and off <= close * reach
                if not counts and t != zero and not src[ENDED + i] > zero:
                    w[DISTANCE + i] = zero
                    again += one
            if again == zero:
                break
        # Where the loop went on to its end, those that converge have done so long before.
        for _ in range(LAST_STEPS if moving == zero else 0):
            moving = zero
            for i in range(BLOCK):
                t, n = w[DISTANCE + i], src[N + i]
                slope = src[L + i] * w[SLOPE_X + i] + src[M + i] * w[SLOPE_Y + i] - n
                # Compared without a division; one that is far off has not converged at all.
                residual = w[SAG + i] - n * t
                off, reach = math.fabs(residual), math.fabs(slope) * (math.fabs(t) + scale)
                again = off > closest * reach and off <= close * reach
                if again and not src[ENDED + i] > zero:
                    w[DISTANCE + i] = t - residual / slope
                    moving += one
            if moving == zero:
                break
            for i in range(BLOCK):
                t = w[DISTANCE + i]
                w[POINT_X + i] = dst[X + i] + src[L + i] * t
                w[POINT_Y + i] = dst[Y + i] + src[M + i] * t
            call_block(q[SAG_AND_SLOPES], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            t, sag, sx, sy = w[DISTANCE + i], w[SAG + i], w[SLOPE_X + i], w[SLOPE_Y + i]
            residual = sag - n * t
            slope = l * sx + m * sy - n
            size = math.fabs(slope)
            steep = size if size > one else one
            allowed = rounding * (math.fabs(sag) + (math.fabs(t) + scale) * steep)
            allowed -= math.fabs(residual)
            # Compared one by one: a minimum would lose a NaN.
            met = one if dst[Z + i] > grazing else zero
            met = met if sense * slope < zero else zero
            met = met if w[MARGIN + i] > zero else zero
            met = met if allowed > zero else zero
            # One step more, too short to matter for the slopes.
            change = clamp(
                residual / math.copysign(size if size > grazing else grazing, slope), scale
            )
            met = met if math.fabs(change) <= uncertain * (math.fabs(t) + scale) else zero
            met = met if math.fabs(residual) <= limit else zero
            t = clamp(t - change, limit)
            met = met if math.fabs(t) < limit else zero
            dst[X + i], dst[Y + i], dst[Z + i] = dst[X + i] + t * l, dst[Y + i] + t * m, t * n
            dst[TRAVELLED + i] += t
            dst[ENDED + i] = met
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, sx, sy = dst[X + i], dst[Y + i], w[SLOPE_X + i], w[SLOPE_Y + i]
            met = dst[ENDED + i]
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * dst[TRAVELLED + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            l2, m2, n2, transmitted = refract(l, m, n, -sx * nz, -sy * nz, nz, w[RATIO + i], behind)
            if refracts:
                l, m, n = l2, m2, n2  # noqa: E741
            else:
                transmitted = one
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            set_status(src, dst, i, tag, edge, x, y, met, zero, transmitted)

    return kernel


def explicit_adjoint(real: types.Type, lossy: bool = False) -> Callable[..., None]:
    """Sweep cotangents back through a surface, in place.

    With F = z - sag and g = ∇F, the ray meets the surface at P = Q + t·d, where
    dt = -(g·(dQ + t·dd) + F_θ·dθ)/(g·d).  With τ = (P̄·d + n̄·path)/(g·d), where n̄ is the index in
    front times the path's cotangent, Q̄ = P̄ - τ·g, d̄ gains t·Q̄, and θ̄ gains -τ·F_θ.

    Args:
        real: the precision.
        lossy: add the cotangents of the cosines.
    """
    *_, refract_adjoint = arithmetic(real)
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        refracts = q[REFRACTS] != 0
        for i in range(BLOCK):
            w[POINT_X + i] = dst[X + i]
            w[POINT_Y + i] = dst[Y + i]
        call_block(q[SAG_HESSIAN], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            nx, ny = -sx * nz, -sy * nz
            la, mb, nc = cot[L + i], cot[M + i], cot[N + i]
            if lossy:
                inner, outer = w[OF_ARRIVING + i], w[OF_LEAVING + i]
                la, mb, nc = la + outer * nx, mb + outer * ny, nc + outer * nz
            dl, dm, dn, vx, vy, vz, of_before, of_behind, per_cosine = refract_adjoint(
                la, mb, nc, l, m, n, nx, ny, nz,
                dst[L + i], dst[M + i], dst[N + i], w[RATIO + i], w[INVERSE_INDEX + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = la, mb, nc
                vx = vy = vz = of_before = of_behind = zero
            if lossy:
                # Of the cosines d·N and d'·N, where the normal moves with the point.
                dl, dm, dn = dl + inner * nx, dm + inner * ny, dn + inner * nz
                vx += inner * l + outer * dst[L + i]
                vy += inner * m + outer * dst[M + i]
                vz += inner * n + outer * dst[N + i]
            across = vx * nx + vy * ny + vz * nz
            of_sx, of_sy = -(vx - across * nx) * nz, -(vy - across * ny) * nz
            px = cot[X + i] + of_sx * w[SAG_XX + i] + of_sy * w[SAG_XY + i]
            py = cot[Y + i] + of_sx * w[SAG_XY + i] + of_sy * w[SAG_YY + i]
            pz = cot[Z + i]
            path, t = cot[PATH + i], dst[TRAVELLED + i]
            along = (px * l + py * m + pz * n + w[INDEX + i] * path) * per_cosine * nz
            qx, qy, qz = px + along * sx, py + along * sy, pz - along
            cot[X + i], cot[Y + i], cot[Z + i] = qx, qy, qz
            cot[L + i] = dl + t * qx
            cot[M + i] = dm + t * qy
            cot[N + i] = dn + t * qz
            cot[OF_FRONT + i] = of_before + path * t
            cot[OF_BEHIND + i] = of_behind
            cot[OF_SHIFT + i] = qz
            w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i] = along, of_sx, of_sy
        call_block(q[PARAMETERS], before, after, cotangents, record, work, codes)

    return kernel


def lossy_explicit_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a surface that loses light, in place."""
    return explicit_adjoint(real, True)


def given_by_sag(
    sag: Factory, sag_hessian: Factory, parameters: Factory, **options: Any
) -> StepFunctions:
    """Return the functions of a surface that is given by its sag.

    Args:
        sag: factory of the block function that fills the rows of sag, slopes and margin.
        sag_hessian: of the one that fills those of slopes and second derivatives.
        parameters: of the one that fills the cotangents of the shape's numbers.
        options: further fields of `StepFunctions`.
    """
    return StepFunctions(
        *(explicit_forward, explicit_adjoint, sag, sag_hessian, parameters),
        lossy_adjoint=lossy_explicit_adjoint,
        **options,
    )
