"""Conics of revolution: the closed form of `dolens.optics.surfaces.conic`, and its adjoint.

F = z - c(x² + y² + (1+k)z²)/2 has the gradient g = (-cx, -cy, 1 - (1+k)cz); the normal is g/|g|.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS


@cache
def conic_distance(real: types.Type) -> Any:
    """Compiled: distance from the vertex plane to a conic, and D; see `optics.surfaces.conic`."""
    _, safe_sqrt, *_ = arithmetic(real)
    zero, one, grazing, flat = real(0.0), real(1.0), real(1e-9), real(1e-15)

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
    clamp, safe_sqrt, arrive, refract, _ = arithmetic(real)
    distance = conic_distance(real)
    zero, one, two, three, grazing = real(0.0), real(1.0), real(2.0), real(3.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        shift, limit, sense, tag, c, k = p[0], p[12], p[18], p[19], p[24], p[25]
        edge, refracts = p[14], q[5] != 0
        bent = (one + k) * c
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, t0, met = arrive(
                src[i], src[128 + i], src[256 + i] + shift, l, m, n, sense, limit
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
            dst[i], dst[128 + i], dst[256 + i] = x, y, z
            travelled = t0 + t
            dst[1152 + i] = travelled
            dst[768 + i] = src[768 + i] + w[i] * travelled
            transmitted = one
            if refracts:
                l, m, n, transmitted = refract(  # noqa: E741
                    l, m, n, gx * inverse, gy * inverse, branch * inverse, w[128 + i], sense
                )
            dst[384 + i], dst[512 + i], dst[640 + i] = l, m, n
            ended, vignetted = src[896 + i], src[1024 + i]
            ended = ended if ended > zero or met > zero else tag + three
            dst[896 + i] = ended if ended > zero or transmitted > zero else tag + two
            inside = edge - (x * x + y * y)
            dst[1024 + i] = vignetted if vignetted > zero or inside > zero else tag + one

    return kernel


def conic_adjoint(real: types.Type) -> Callable[..., None]:
    """Cotangents in front of a conic from those behind it, in place; see `explicit_adjoint`."""
    *_, refract_adjoint = arithmetic(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        cot = carray(cotangents, 5376)
        c, k, refracts = p[24], p[25], q[5] != 0
        e = one + k
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, z = dst[i], dst[128 + i], dst[256 + i]
            gx, gy, gz = -c * x, -c * y, one - e * c * z
            inverse = one / math.sqrt(gx * gx + gy * gy + gz * gz)
            nx, ny, nz = gx * inverse, gy * inverse, gz * inverse
            dl, dm, dn, vx, vy, vz, of_before, of_behind, per_cosine = refract_adjoint(
                cot[384 + i], cot[512 + i], cot[640 + i], l, m, n, nx, ny, nz,
                dst[384 + i], dst[512 + i], dst[640 + i], w[128 + i], w[3072 + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = cot[384 + i], cot[512 + i], cot[640 + i]
                vx = vy = vz = of_before = of_behind = zero
            # The cotangent of g: what lies across the normal, over |g|.
            across = vx * nx + vy * ny + vz * nz
            vx, vy, vz = (
                (vx - across * nx) * inverse,
                (vy - across * ny) * inverse,
                (vz - across * nz) * inverse,
            )
            px, py, pz = cot[i] - c * vx, cot[128 + i] - c * vy, cot[256 + i] - e * c * vz
            path, t = cot[768 + i], dst[1152 + i]
            along = (px * l + py * m + pz * n + w[i] * path) * per_cosine * inverse
            qx, qy, qz = px - along * gx, py - along * gy, pz - along * gz
            cot[i], cot[128 + i], cot[256 + i] = qx, qy, qz
            cot[384 + i] = dl + t * qx
            cot[512 + i] = dm + t * qy
            cot[640 + i] = dn + t * qz
            cot[896 + i] = of_before + path * t
            cot[1024 + i] = of_behind
            cot[2048 + i] = qz
            cot[5120 + i] = half * along * (x * x + y * y + e * z * z) - (
                vx * x + vy * y + e * vz * z
            )
            cot[5248 + i] = c * z * (half * along * z - vz)

    return kernel
