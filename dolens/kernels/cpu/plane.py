"""Planes and aperture stops, and their adjoint."""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic


def plane_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a plane and through it."""
    _, safe_sqrt, arrive, _, _ = arithmetic(real)
    zero, one, two, three, grazing = real(0.0), real(1.0), real(2.0), real(3.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        shift, limit, sense, tag = p[0], p[12], p[18], p[19]
        refracts = q[5] != 0
        edge = p[14]
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, t, met = arrive(src[i], src[128 + i], src[256 + i] + shift, l, m, n, sense, limit)
            dst[i], dst[128 + i], dst[256 + i] = x, y, zero
            dst[1152 + i] = t
            dst[768 + i] = src[768 + i] + w[i] * t
            ratio = w[128 + i]
            squared = (one - ratio * ratio) + (ratio * ratio) * (n * n)
            if refracts:
                l, m, n = ratio * l, ratio * m, sense * safe_sqrt(squared)  # noqa: E741
            else:
                squared = one
            dst[384 + i], dst[512 + i], dst[640 + i] = l, m, n
            ended, vignetted = src[896 + i], src[1024 + i]
            ended = ended if ended > zero or met > grazing else tag + three
            dst[896 + i] = ended if ended > zero or squared > zero else tag + two
            inside = edge - (x * x + y * y)
            dst[1024 + i] = vignetted if vignetted > zero or inside > zero else tag + one

    return kernel


def plane_adjoint(real: types.Type) -> Callable[..., None]:
    """Cotangents in front of a plane from those behind it, in place.

    l' = μl, m' = μm, n'² = 1 - μ²(1 - n²); on the plane z = 0 and the distance is -z/n.
    """
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        w, q = carray(work, 6144), carray(codes, 24)
        cot = carray(cotangents, 2176)
        refracts = q[5] != 0
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            a, b, c = cot[384 + i], cot[512 + i], cot[640 + i]
            of_before = of_behind = zero
            if refracts:
                ratio, behind = w[128 + i], dst[640 + i]
                of_ratio = a * l + b * m - c * ratio * (one - n * n) / behind
                of_before = of_ratio * ratio * w[3072 + i]
                of_behind = -of_before * ratio
                a, b, c = ratio * a, ratio * b, ratio * ratio * n / behind * c
            path, t = cot[768 + i], dst[1152 + i]
            x, y = cot[i], cot[128 + i]
            z = -(x * l + y * m + w[i] * path) / n
            cot[256 + i] = z
            cot[384 + i], cot[512 + i], cot[640 + i] = a + t * x, b + t * y, c + t * z
            cot[896 + i] = of_before + path * t
            cot[1024 + i] = of_behind
            cot[2048 + i] = z

    return kernel


def clip(real: types.Type) -> Callable[..., None]:
    """Vignette where the clear aperture is no full circle; the circle is tested on the way."""
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        dst, p, q = carray(after, 1280), carray(record, 32), carray(codes, 24)
        half_x, half_y, hole_x, hole_y, tag = p[15], p[20], p[16], p[17], p[19]
        rectangle, hole = q[6] == 2, q[7]
        for i in range(128):
            x, y = math.fabs(dst[i]), math.fabs(dst[128 + i])
            passes = not rectangle or (x < half_x and y < half_y)
            if hole == 1:
                passes = passes and x * x + y * y > hole_x
            elif hole == 2:
                passes = passes and (x > hole_x or y > hole_y)
            if not passes and not dst[1024 + i] > zero:
                dst[1024 + i] = tag + one

    return kernel
