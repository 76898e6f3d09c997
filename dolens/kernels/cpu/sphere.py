"""Spheres: the closed form of `dolens.optics.surfaces.conic`, and its adjoint.

F = z - c(x² + y² + z²)/2 has the gradient N = (-cx, -cy, 1 - cz), a unit vector on the sphere.
"""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic


def sphere_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a sphere and through it."""
    clamp, safe_sqrt, arrive, refract, _ = arithmetic(real)
    zero, one, two, three, grazing = real(0.0), real(1.0), real(2.0), real(3.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        shift, limit, sense, tag, c = p[0], p[12], p[18], p[19], p[24]
        edge, refracts = p[14], q[5] != 0
        # Three loops: a processor looks only so far ahead, and this way finds several iterations'
        # divisions and roots to work on at once.
        for i in range(128):
            x, y, t, met = arrive(
                src[i], src[128 + i], src[256 + i] + shift,
                src[384 + i], src[512 + i], src[640 + i], sense, limit,
            )  # fmt: skip
            dst[i], dst[128 + i], dst[1152 + i], dst[896 + i] = x, y, t, met
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, met = dst[i], dst[128 + i], dst[896 + i]
            f = c * (x * x + y * y)
            g = n - c * (l * x + m * y)
            squared = g * g - c * f
            near = sense * g + safe_sqrt(squared)
            t = clamp(sense * f / (near if near > grazing else grazing), limit)
            dst[i], dst[128 + i], dst[256 + i] = x + t * l, y + t * m, t * n
            dst[1152 + i] += t
            met = met if math.fabs(t) < limit else zero
            dst[896 + i] = squared if met > grazing else zero
        for i in range(128):
            x, y, z, met = dst[i], dst[128 + i], dst[256 + i], dst[896 + i]
            nx, ny, nz = -c * x, -c * y, one - c * z
            met = met if nz > zero else zero
            dst[768 + i] = src[768 + i] + w[i] * dst[1152 + i]
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            transmitted = one
            if refracts:
                l, m, n, transmitted = refract(l, m, n, nx, ny, nz, w[128 + i], sense)  # noqa: E741
            dst[384 + i], dst[512 + i], dst[640 + i] = l, m, n
            ended, vignetted = src[896 + i], src[1024 + i]
            ended = ended if ended > zero or met > zero else tag + three
            dst[896 + i] = ended if ended > zero or transmitted > zero else tag + two
            inside = edge - (x * x + y * y)
            dst[1024 + i] = vignetted if vignetted > zero or inside > zero else tag + one

    return kernel


def sphere_adjoint(real: types.Type) -> Callable[..., None]:
    """Cotangents in front of a sphere from those behind it, in place; see `explicit_adjoint`."""
    *_, refract_adjoint = arithmetic(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        cot = carray(cotangents, 5248)
        c, refracts = p[24], q[5] != 0
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, z = dst[i], dst[128 + i], dst[256 + i]
            nx, ny, nz = -c * x, -c * y, one - c * z
            dl, dm, dn, gx, gy, gz, of_before, of_behind, per_cosine = refract_adjoint(
                cot[384 + i], cot[512 + i], cot[640 + i], l, m, n, nx, ny, nz,
                dst[384 + i], dst[512 + i], dst[640 + i], w[128 + i], w[3072 + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = cot[384 + i], cot[512 + i], cot[640 + i]
                gx = gy = gz = of_before = of_behind = zero
            px, py, pz = cot[i] - c * gx, cot[128 + i] - c * gy, cot[256 + i] - c * gz
            path, t = cot[768 + i], dst[1152 + i]
            along = (px * l + py * m + pz * n + w[i] * path) * per_cosine
            of_c = half * along * (x * x + y * y + z * z) - (gx * x + gy * y + gz * z)
            qx, qy, qz = px - along * nx, py - along * ny, pz - along * nz
            cot[i], cot[128 + i], cot[256 + i] = qx, qy, qz
            cot[384 + i] = dl + t * qx
            cot[512 + i] = dm + t * qy
            cot[640 + i] = dn + t * qz
            cot[896 + i] = of_before + path * t
            cot[1024 + i] = of_behind
            cot[2048 + i] = qz
            cot[5120 + i] = of_c

    return kernel
