"""Surfaces that are given by their sag: Newton's iteration, refraction, and the adjoint.

A shape gives three block functions, by address in its codes: `sag` (sag, slopes, and the margin of
its branch at the points in work rows 2 and 3), `bend` (slopes and second derivatives there), and
`parameters` (cotangents of its numbers from those of sag and slopes).
"""

import math
from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import call_block
from dolens.kernels.cpu.conic import conic_distance


def explicit_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to the surface and through it; see `Surface.intersect`.

    The iteration ends when no ray moves any more, or after 40 steps; whether a ray has converged is
    read off its residual at the end.
    """
    clamp, _, arrive, refract, _ = arithmetic(real)
    distance = conic_distance(real)
    zero, one, two, three, grazing = real(0.0), real(1.0), real(2.0), real(3.0), real(1e-9)
    epsilon = real(2.0**-23 if real is types.float32 else 2.0**-52)
    close, rounding = real(math.sqrt(float(epsilon))), real(64.0) * epsilon
    uncertain = real(1e-2)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, q = carray(record, 32), carray(work, 6144), carray(codes, 24)
        shift, limit, scale, sense, tag = p[0], p[12], p[13], p[18], p[19]
        edge = p[14]
        refracts = q[5] != 0
        # The point on the vertex plane, and its margin, stay in the rows that they end in.
        for i in range(128):
            x, y, t, met = arrive(
                src[i], src[128 + i], src[256 + i] + shift,
                src[384 + i], src[512 + i], src[640 + i], sense, limit,
            )  # fmt: skip
            dst[i], dst[128 + i], dst[256 + i], dst[1152 + i] = x, y, met, t
            w[1792 + i] = zero
        w[3200] = zero
        if q[0] == 3:
            c, k = p[24], p[25]
            for i in range(128):
                n = src[640 + i]
                t, squared = distance(
                    c, c + (c * k) * (n * n), dst[i], dst[128 + i],
                    src[384 + i], src[512 + i], n, sense,
                )  # fmt: skip
                w[1792 + i] = clamp(t, limit) if squared > zero else zero
        for _ in range(40):
            for i in range(128):
                t = w[1792 + i]
                w[256 + i] = dst[i] + src[384 + i] * t
                w[384 + i] = dst[128 + i] + src[512 + i] * t
            call_block(q[18], before, after, cotangents, record, work, codes)
            moving = zero
            for i in range(128):
                t, n = w[1792 + i], src[640 + i]
                slope = src[384 + i] * w[640 + i] + src[512 + i] * w[768 + i] - n
                size = math.fabs(slope)
                change = (w[512 + i] - n * t) / math.copysign(
                    size if size > grazing else grazing, slope
                )
                change = clamp(change, scale)
                t = t - change
                w[1792 + i] = t
                # A ray that has ended already keeps no other waiting.
                far = math.fabs(change) > close * (math.fabs(t) + scale)
                moving += one if far and not src[896 + i] > zero else zero
            if moving == zero:
                break
        for i in range(128):
            t = w[1792 + i]
            w[256 + i] = dst[i] + src[384 + i] * t
            w[384 + i] = dst[128 + i] + src[512 + i] * t
        call_block(q[18], before, after, cotangents, record, work, codes)
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            t, sag, sx, sy = w[1792 + i], w[512 + i], w[640 + i], w[768 + i]
            residual = sag - n * t
            slope = l * sx + m * sy - n
            size = math.fabs(slope)
            steep = size if size > one else one
            allowed = rounding * (math.fabs(sag) + (math.fabs(t) + scale) * steep)
            allowed -= math.fabs(residual)
            # Compared one by one: a minimum would lose a NaN.
            met = one if dst[256 + i] > grazing else zero
            met = met if sense * slope < zero else zero
            met = met if w[896 + i] > zero else zero
            met = met if allowed > zero else zero
            # One step more, too short to matter for the slopes.
            change = clamp(
                residual / math.copysign(size if size > grazing else grazing, slope), scale
            )
            met = met if math.fabs(change) <= uncertain * (math.fabs(t) + scale) else zero
            met = met if math.fabs(residual) <= limit else zero
            t = clamp(t - change, limit)
            met = met if math.fabs(t) < limit else zero
            dst[i], dst[128 + i], dst[256 + i] = dst[i] + t * l, dst[128 + i] + t * m, t * n
            dst[1152 + i] += t
            dst[896 + i] = met
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, sx, sy, met = dst[i], dst[128 + i], w[640 + i], w[768 + i], dst[896 + i]
            dst[768 + i] = src[768 + i] + w[i] * dst[1152 + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            l2, m2, n2, transmitted = refract(l, m, n, -sx * nz, -sy * nz, nz, w[128 + i], sense)
            if refracts:
                l, m, n = l2, m2, n2  # noqa: E741
            else:
                transmitted = one
            dst[384 + i], dst[512 + i], dst[640 + i] = l, m, n
            ended, vignetted = src[896 + i], src[1024 + i]
            ended = ended if ended > zero or met > zero else tag + three
            dst[896 + i] = ended if ended > zero or transmitted > zero else tag + two
            inside = edge - (x * x + y * y)
            dst[1024 + i] = vignetted if vignetted > zero or inside > zero else tag + one

    return kernel


def explicit_adjoint(real: types.Type) -> Callable[..., None]:
    """Cotangents in front of a surface from those behind it, in place.

    With F = z - sag and g = ∇F, the ray meets the surface at P = Q + t·d, where
    dt = -(g·(dQ + t·dd) + F_θ·dθ)/(g·d).  With τ = (P̄·d + n̄·path)/(g·d), where n̄ is the index in
    front times the path's cotangent, Q̄ = P̄ - τ·g, d̄ gains t·Q̄, and θ̄ gains -τ·F_θ.
    """
    *_, refract_adjoint = arithmetic(real)
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        w, q = carray(work, 6144), carray(codes, 24)
        cot = carray(cotangents, 2176)
        refracts = q[5] != 0
        for i in range(128):
            w[256 + i] = dst[i]
            w[384 + i] = dst[128 + i]
        call_block(q[19], before, after, cotangents, record, work, codes)
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            sx, sy = w[640 + i], w[768 + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            nx, ny = -sx * nz, -sy * nz
            dl, dm, dn, vx, vy, vz, of_before, of_behind, per_cosine = refract_adjoint(
                cot[384 + i], cot[512 + i], cot[640 + i], l, m, n, nx, ny, nz,
                dst[384 + i], dst[512 + i], dst[640 + i], w[128 + i], w[3072 + i],
            )  # fmt: skip
            if not refracts:
                dl, dm, dn = cot[384 + i], cot[512 + i], cot[640 + i]
                vx = vy = vz = of_before = of_behind = zero
            across = vx * nx + vy * ny + vz * nz
            of_sx, of_sy = -(vx - across * nx) * nz, -(vy - across * ny) * nz
            px = cot[i] + of_sx * w[1024 + i] + of_sy * w[1152 + i]
            py = cot[128 + i] + of_sx * w[1152 + i] + of_sy * w[1280 + i]
            pz = cot[256 + i]
            path, t = cot[768 + i], dst[1152 + i]
            along = (px * l + py * m + pz * n + w[i] * path) * per_cosine * nz
            qx, qy, qz = px + along * sx, py + along * sy, pz - along
            cot[i], cot[128 + i], cot[256 + i] = qx, qy, qz
            cot[384 + i] = dl + t * qx
            cot[512 + i] = dm + t * qy
            cot[640 + i] = dn + t * qz
            cot[896 + i] = of_before + path * t
            cot[1024 + i] = of_behind
            cot[2048 + i] = qz
            w[1408 + i], w[1536 + i], w[1664 + i] = along, of_sx, of_sy
        call_block(q[20], before, after, cotangents, record, work, codes)

    return kernel
