"""Rays meet spheres and conics of revolution in the closed form of `dolens.kernels.conic`."""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.conic import conic_distance, conic_gradient, shape_cotangents
from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    EDGE,
    ENDED,
    INDEX,
    INVERSE_INDEX,
    LIMIT,
    OF_ARRIVING,
    OF_BEHIND,
    OF_FRONT,
    OF_LEAVING,
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
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.table import GRAZING


def _forward(real: types.Type, is_sphere: bool) -> Callable[..., None]:
    clamp, safe_sqrt, arrive, set_status, refract, _ = arithmetic(real)
    distance, gradient = scalar(conic_distance, real), scalar(conic_gradient, real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        shift, limit, sense, tag, c = p[SHIFT], p[LIMIT], p[SENSE], p[TAG], p[SHAPE]
        k = zero if is_sphere else p[SHAPE + 1]
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
            if is_sphere:
                # The far root is beyond the equator.
                f = c * (x * x + y * y)
                g = n - c * (l * x + m * y)
                squared = g * g - c * f
                near = sense * g + safe_sqrt(squared)
                t = sense * f / (near if near > grazing else grazing)
            else:
                t, squared = distance(c, c + (c * k) * (n * n), x, y, l, m, n, sense)
            t = clamp(t, limit)
            dst[X + i], dst[Y + i], dst[Z + i] = x + t * l, y + t * m, t * n
            dst[TRAVELLED + i] += t
            met = met if math.fabs(t) < limit else zero
            dst[ENDED + i] = squared if met > grazing else zero
        for i in range(BLOCK):
            x, y, z, met = dst[X + i], dst[Y + i], dst[Z + i], dst[ENDED + i]
            gx, gy, gz = gradient(c, k, x, y, z)
            # Compared one by one: a minimum would lose a NaN.
            met = met if gz > zero else zero
            inverse = one if is_sphere else one / safe_sqrt(gx * gx + gy * gy + gz * gz)
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * dst[TRAVELLED + i]
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            transmitted = one
            if refracts:
                l, m, n, transmitted = refract(  # noqa: E741
                    l, m, n, gx * inverse, gy * inverse, gz * inverse, w[RATIO + i], behind
                )
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            set_status(src, dst, i, tag, edge, x, y, met, zero, transmitted)

    return kernel


def _adjoint(real: types.Type, is_sphere: bool, lossy: bool = False) -> Callable[..., None]:
    *_, refract_adjoint = arithmetic(real)
    gradient, shape = scalar(conic_gradient, real), scalar(shape_cotangents, real)
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        c, refracts = p[SHAPE], q[REFRACTS] != 0
        k = zero if is_sphere else p[SHAPE + 1]
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, z = dst[X + i], dst[Y + i], dst[Z + i]
            gx, gy, gz = gradient(c, k, x, y, z)
            inverse = one if is_sphere else one / math.sqrt(gx * gx + gy * gy + gz * gz)
            nx, ny, nz = gx * inverse, gy * inverse, gz * inverse
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
            if not is_sphere:
                # The cotangent of g: what lies across the normal, over |g|.
                across = vx * nx + vy * ny + vz * nz
                vx, vy = (vx - across * nx) * inverse, (vy - across * ny) * inverse
                vz = (vz - across * nz) * inverse
            px, py, pz = cot[X + i] - c * vx, cot[Y + i] - c * vy, cot[Z + i] - (one + k) * c * vz
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
            of_c, of_k = shape(c, k, x, y, z, along, vx, vy, vz)
            cot[OF_SHAPE + i] = of_c
            if not is_sphere:
                cot[OF_SECOND + i] = of_k

    return kernel


def conic_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a conic and through it."""
    return _forward(real, False)


def conic_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a conic, in place; see `explicit_adjoint`."""
    return _adjoint(real, False)


def sphere_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a sphere and through it."""
    return _forward(real, True)


def sphere_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a sphere, in place."""
    return _adjoint(real, True)


def lossy_conic_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a conic that loses light, in place."""
    return _adjoint(real, False, True)


def lossy_sphere_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a sphere that loses light, in place."""
    return _adjoint(real, True, True)
