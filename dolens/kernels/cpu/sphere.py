"""Rays meet a sphere in the closed form of `dolens.optics.surfaces.conic`.

F = z - c(x² + y² + z²)/2 has the gradient N = (-cx, -cy, 1 - cz), a unit vector on the sphere.
"""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import StepFunctions
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    EDGE,
    ENDED,
    INDEX,
    INVERSE_INDEX,
    LIMIT,
    OF_BEHIND,
    OF_FRONT,
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


def sphere_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a sphere and through it."""
    clamp, safe_sqrt, arrive, set_status, refract, _ = arithmetic(real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        shift, limit, sense, tag, c = p[SHIFT], p[LIMIT], p[SENSE], p[TAG], p[SHAPE]
        edge, behind, refracts = p[EDGE], p[SENSE_BEHIND], q[REFRACTS] != 0
        # Three loops: a processor looks only so far ahead, and this way finds several iterations'
        # divisions and roots to work on at once.
        for i in range(BLOCK):
            x, y, t, met = arrive(
                src[X + i], src[Y + i], src[Z + i] + shift,
                src[L + i], src[M + i], src[N + i], sense, limit,
            )  # fmt: skip
            dst[X + i], dst[Y + i], dst[TRAVELLED + i], dst[ENDED + i] = x, y, t, met
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, met = dst[X + i], dst[Y + i], dst[ENDED + i]
            f = c * (x * x + y * y)
            g = n - c * (l * x + m * y)
            squared = g * g - c * f
            near = sense * g + safe_sqrt(squared)
            t = clamp(sense * f / (near if near > grazing else grazing), limit)
            dst[X + i], dst[Y + i], dst[Z + i] = x + t * l, y + t * m, t * n
            dst[TRAVELLED + i] += t
            met = met if math.fabs(t) < limit else zero
            dst[ENDED + i] = squared if met > grazing else zero
        for i in range(BLOCK):
            x, y, z, met = dst[X + i], dst[Y + i], dst[Z + i], dst[ENDED + i]
            nx, ny, nz = -c * x, -c * y, one - c * z
            met = met if nz > zero else zero
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * dst[TRAVELLED + i]
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            transmitted = one
            if refracts:
                l, m, n, transmitted = refract(l, m, n, nx, ny, nz, w[RATIO + i], behind)  # noqa: E741
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            set_status(src, dst, i, tag, edge, x, y, met, zero, transmitted)

    return kernel


def sphere_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a sphere, in place; see `explicit_adjoint`."""
    *_, refract_adjoint = arithmetic(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        c, refracts = p[SHAPE], q[REFRACTS] != 0
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, z = dst[X + i], dst[Y + i], dst[Z + i]
            nx, ny, nz = -c * x, -c * y, one - c * z
            dl, dm, dn, gx, gy, gz, of_before, of_behind, per_cosine = refract_adjoint(
                cot[L + i], cot[M + i], cot[N + i], l, m, n, nx, ny, nz,
                dst[L + i], dst[M + i], dst[N + i], w[RATIO + i], w[INVERSE_INDEX + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = cot[L + i], cot[M + i], cot[N + i]
                gx = gy = gz = of_before = of_behind = zero
            px, py, pz = cot[X + i] - c * gx, cot[Y + i] - c * gy, cot[Z + i] - c * gz
            path, t = cot[PATH + i], dst[TRAVELLED + i]
            along = (px * l + py * m + pz * n + w[INDEX + i] * path) * per_cosine
            of_c = half * along * (x * x + y * y + z * z) - (gx * x + gy * y + gz * z)
            qx, qy, qz = px - along * nx, py - along * ny, pz - along * nz
            cot[X + i], cot[Y + i], cot[Z + i] = qx, qy, qz
            cot[L + i] = dl + t * qx
            cot[M + i] = dm + t * qy
            cot[N + i] = dn + t * qz
            cot[OF_FRONT + i] = of_before + path * t
            cot[OF_BEHIND + i] = of_behind
            cot[OF_SHIFT + i] = qz
            cot[OF_SHAPE + i] = of_c

    return kernel


KERNELS = StepFunctions(sphere_forward, sphere_adjoint)
