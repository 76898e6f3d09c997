"""Rays meet a conic of revolution in the closed form of `dolens.optics.surfaces.conic`.

F = z - c(x² + y² + (1+k)z²)/2 has the gradient g = (-cx, -cy, 1 - (1+k)cz); the normal is g/|g|.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS, StepFunctions
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    EDGE,
    INDEX,
    INVERSE_INDEX,
    LIMIT,
    OF_BEHIND,
    OF_FRONT,
    OF_SECOND,
    OF_SHAPE,
    OF_SHIFT,
    PATH,
    RATIO,
    REFRACTS,
    SENSE,
    SENSE_BEHIND,
    SHAPE,
    SHIFT,
    SHORT_RECORD,
    STATE,
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
from dolens.kernels.table import GRAZING


@cache
def conic_distance(real: types.Type) -> Any:
    """Compile the distance from the vertex plane to a conic, and D; see `optics.surfaces.conic`."""
    _, safe_sqrt, *_ = arithmetic(real)
    zero, one, grazing, flat = real(0.0), real(1.0), real(GRAZING), real(1e-15)

    @njit(**OPTIONS)
    def distance(c, a, x, y, l, m, n, sense):  # noqa: ANN001, ANN202, E741
        f = c * (x * x + y * y)
        g = n - c * (l * x + m * y)
        squared = g * g - a * f
        root = safe_sqrt(squared)
        along = sense * g
        near = along + root
        near = f / (near if near > grazing else grazing)
        size = -a if a < zero else a
        far = (along - root) / (one if size < flat else a)
        return sense * (near if along > zero else far), squared

    return distance


def conic_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a conic and through it."""
    clamp, safe_sqrt, arrive, set_status, refract, _ = arithmetic(real)
    distance = conic_distance(real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        shift, limit, sense, tag, c = p[SHIFT], p[LIMIT], p[SENSE], p[TAG], p[SHAPE]
        k = p[SHAPE + 1]
        edge, behind, refracts = p[EDGE], p[SENSE_BEHIND], q[REFRACTS] != 0
        bent = (one + k) * c
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, t0, met = arrive(
                src[X + i], src[Y + i], src[Z + i] + shift, l, m, n, sense, limit
            )
            t, squared = distance(c, c + (c * k) * (n * n), x, y, l, m, n, sense)
            t = clamp(t, limit)
            x, y, z = x + t * l, y + t * m, t * n
            branch = one - bent * z
            # Compared one by one: a minimum would lose a NaN.
            met = one if met > grazing else zero
            met = met if math.fabs(t) < limit else zero
            met = met if squared > zero else zero
            met = met if branch > zero else zero
            gx, gy = -c * x, -c * y
            inverse = one / safe_sqrt(gx * gx + gy * gy + branch * branch)
            dst[X + i], dst[Y + i], dst[Z + i] = x, y, z
            travelled = t0 + t
            dst[TRAVELLED + i] = travelled
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * travelled
            transmitted = one
            if refracts:
                l, m, n, transmitted = refract(  # noqa: E741
                    l, m, n, gx * inverse, gy * inverse, branch * inverse, w[RATIO + i], behind
                )
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            set_status(src, dst, i, tag, edge, x, y, met, zero, transmitted)

    return kernel


def conic_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a conic, in place; see `explicit_adjoint`."""
    *_, refract_adjoint = arithmetic(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        c, k, refracts = p[SHAPE], p[SHAPE + 1], q[REFRACTS] != 0
        e = one + k
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, z = dst[X + i], dst[Y + i], dst[Z + i]
            gx, gy, gz = -c * x, -c * y, one - e * c * z
            inverse = one / math.sqrt(gx * gx + gy * gy + gz * gz)
            nx, ny, nz = gx * inverse, gy * inverse, gz * inverse
            dl, dm, dn, vx, vy, vz, of_before, of_behind, per_cosine = refract_adjoint(
                cot[L + i], cot[M + i], cot[N + i], l, m, n, nx, ny, nz,
                dst[L + i], dst[M + i], dst[N + i], w[RATIO + i], w[INVERSE_INDEX + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = cot[L + i], cot[M + i], cot[N + i]
                vx = vy = vz = of_before = of_behind = zero
            # The cotangent of g: what lies across the normal, over |g|.
            across = vx * nx + vy * ny + vz * nz
            vx, vy = (vx - across * nx) * inverse, (vy - across * ny) * inverse
            vz = (vz - across * nz) * inverse
            px, py, pz = cot[X + i] - c * vx, cot[Y + i] - c * vy, cot[Z + i] - e * c * vz
            path, t = cot[PATH + i], dst[TRAVELLED + i]
            along = (px * l + py * m + pz * n + w[INDEX + i] * path) * per_cosine * inverse
            qx, qy, qz = px - along * gx, py - along * gy, pz - along * gz
            cot[X + i], cot[Y + i], cot[Z + i] = qx, qy, qz
            cot[L + i] = dl + t * qx
            cot[M + i] = dm + t * qy
            cot[N + i] = dn + t * qz
            cot[OF_FRONT + i] = of_before + path * t
            cot[OF_BEHIND + i] = of_behind
            cot[OF_SHIFT + i] = qz
            cot[OF_SHAPE + i] = half * along * (x * x + y * y + e * z * z) - (
                vx * x + vy * y + e * vz * z
            )
            cot[OF_SECOND + i] = c * z * (half * along * z - vz)

    return kernel


KERNELS = StepFunctions(conic_forward, conic_adjoint)
