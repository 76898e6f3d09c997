"""Steps between surfaces of different poses, and to the sensor, and their adjoints.

They mirror `change_axes` and `to_lens_axes` of `dolens.optics.elements`, and `trace_to_plane`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS


@cache
def _turns(real: types.Type) -> tuple[Any, Any]:
    """Compiled: R·v and Rᵀ·v, with R by rows from slot 3 of a record."""

    @njit(**OPTIONS)
    def turn(p, x, y, z):  # noqa: ANN001, ANN202
        return (
            p[3] * x + p[4] * y + p[5] * z,
            p[6] * x + p[7] * y + p[8] * z,
            p[9] * x + p[10] * y + p[11] * z,
        )

    @njit(**OPTIONS)
    def turn_back(p, x, y, z):  # noqa: ANN001, ANN202
        return (
            p[3] * x + p[6] * y + p[9] * z,
            p[4] * x + p[7] * y + p[10] * z,
            p[5] * x + p[8] * y + p[11] * z,
        )

    return turn, turn_back


def change_axes_forward(real: types.Type) -> Callable[..., None]:
    """Carry rays along their line to the level of the next vertex, and turn them.

    Those that run along that level are turned where they are.
    """
    turn, _ = _turns(real)
    zero, one, grazing = real(0.0), real(1.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w = carray(record, 32), carray(work, 6144)
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            # Factors, since a branch about the division would stop vectorisation.
            crosses, stays = (one, zero) if math.fabs(n) > grazing else (zero, one)
            cosine = n if n > grazing else grazing
            if n < zero:
                cosine = n if n < -grazing else -grazing
            t = crosses * ((p[2] - src[256 + i]) / cosine)
            x, y = src[i] - p[0] + t * l, src[128 + i] - p[1] + t * m
            z = stays * (src[256 + i] - p[2])
            dst[i], dst[128 + i], dst[256 + i] = turn(p, x, y, z)
            dst[384 + i], dst[512 + i], dst[640 + i] = turn(p, l, m, n)
            dst[768 + i] = src[768 + i] + w[i] * t
            dst[896 + i], dst[1024 + i] = src[896 + i], src[1024 + i]
            dst[1152 + i] = t

    return kernel


def change_axes_adjoint(real: types.Type) -> Callable[..., None]:
    """Adjoint of `change_axes_forward`."""
    _, turn_back = _turns(real)
    zero, one, grazing = real(0.0), real(1.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w, cot = carray(record, 32), carray(work, 6144), carray(cotangents, 3584)
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            t = dst[1152 + i]
            crosses, stays = (one, zero) if math.fabs(n) > grazing else (zero, one)
            x, y = src[i] - p[0] + t * l, src[128 + i] - p[1] + t * m
            z = stays * (src[256 + i] - p[2])
            px, py, pz = cot[i], cot[128 + i], cot[256 + i]
            dl, dm, dn = cot[384 + i], cot[512 + i], cot[640 + i]
            cot[2432 + i] = px * x + dl * l
            cot[2560 + i] = px * y + dl * m
            cot[2688 + i] = px * z + dl * n
            cot[2816 + i] = py * x + dm * l
            cot[2944 + i] = py * y + dm * m
            cot[3072 + i] = py * z + dm * n
            cot[3200 + i] = pz * x + dn * l
            cot[3328 + i] = pz * y + dn * m
            cot[3456 + i] = pz * z + dn * n
            qx, qy, qz = turn_back(p, px, py, pz)
            dl, dm, dn = turn_back(p, dl, dm, dn)
            path = cot[768 + i]
            cosine = n if n > grazing else grazing
            if n < zero:
                cosine = n if n < -grazing else -grazing
            along = crosses * ((qx * l + qy * m + w[i] * path) / cosine) - stays * qz
            cot[i], cot[128 + i], cot[256 + i] = qx, qy, -along
            cot[384 + i], cot[512 + i], cot[640 + i] = dl + t * qx, dm + t * qy, dn - t * along
            cot[896 + i] = path * t
            cot[1024 + i] = zero
            cot[2048 + i], cot[2176 + i], cot[2304 + i] = -qx, -qy, along

    return kernel


def lens_axes_forward(real: types.Type) -> Callable[..., None]:
    """See rays from the lens's axes."""
    turn, _ = _turns(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst, p = carray(before, 1280), carray(after, 1280), carray(record, 32)
        for i in range(128):
            x, y, z = turn(p, src[i], src[128 + i], src[256 + i])
            dst[i], dst[128 + i], dst[256 + i] = x + p[0], y + p[1], z + p[2]
            dst[384 + i], dst[512 + i], dst[640 + i] = turn(
                p, src[384 + i], src[512 + i], src[640 + i]
            )
            dst[768 + i], dst[896 + i], dst[1024 + i] = src[768 + i], src[896 + i], src[1024 + i]
            dst[1152 + i] = zero

    return kernel


def lens_axes_adjoint(real: types.Type) -> Callable[..., None]:
    """Adjoint of `lens_axes_forward`."""
    _, turn_back = _turns(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, p, cot = carray(before, 1280), carray(record, 32), carray(cotangents, 3584)
        for i in range(128):
            x, y, z = src[i], src[128 + i], src[256 + i]
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            px, py, pz = cot[i], cot[128 + i], cot[256 + i]
            dl, dm, dn = cot[384 + i], cot[512 + i], cot[640 + i]
            cot[2048 + i], cot[2176 + i], cot[2304 + i] = px, py, pz
            cot[2432 + i] = px * x + dl * l
            cot[2560 + i] = px * y + dl * m
            cot[2688 + i] = px * z + dl * n
            cot[2816 + i] = py * x + dm * l
            cot[2944 + i] = py * y + dm * m
            cot[3072 + i] = py * z + dm * n
            cot[3200 + i] = pz * x + dn * l
            cot[3328 + i] = pz * y + dn * m
            cot[3456 + i] = pz * z + dn * n
            cot[i], cot[128 + i], cot[256 + i] = turn_back(p, px, py, pz)
            cot[384 + i], cot[512 + i], cot[640 + i] = turn_back(p, dl, dm, dn)
            cot[896 + i], cot[1024 + i] = zero, zero

    return kernel


def sensor_forward(real: types.Type) -> Callable[..., None]:
    """Carry rays to the sensor plane; those that do not travel towards it miss it."""
    zero, three, grazing = real(0.0), real(3.0), real(1e-9)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, 1280), carray(after, 1280)
        p, w = carray(record, 32), carray(work, 6144)
        shift, sense, tag = p[0], p[18], p[19]
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            towards = sense * n
            t = -sense * (src[256 + i] + shift) / (towards if towards > grazing else grazing)
            dst[i], dst[128 + i], dst[256 + i] = src[i] + t * l, src[128 + i] + t * m, zero
            dst[384 + i], dst[512 + i], dst[640 + i] = l, m, n
            dst[768 + i] = src[768 + i] + w[i] * t
            ended = src[896 + i]
            dst[896 + i] = ended if ended > zero or towards > grazing else tag + three
            dst[1024 + i] = src[1024 + i]
            dst[1152 + i] = t

    return kernel
