"""Rays change their axes between surfaces of different poses, and are carried to the sensor.

They mirror `change_axes` and `to_lens_axes` of `dolens.optics.elements`, and `trace_to_sensor`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS
from dolens.kernels.cpu.layout import (
    BLOCK,
    ENDED,
    INDEX,
    MISSED,
    OF_BEHIND,
    OF_FRONT,
    OF_STEP_X,
    OF_STEP_Y,
    OF_STEP_Z,
    OF_TURN_XX,
    OF_TURN_XY,
    OF_TURN_XZ,
    OF_TURN_YX,
    OF_TURN_YY,
    OF_TURN_YZ,
    OF_TURN_ZX,
    OF_TURN_ZY,
    OF_TURN_ZZ,
    PATH,
    SENSE,
    SHIFT,
    SHORT_RECORD,
    STATE,
    STEP_X,
    STEP_Y,
    STEP_Z,
    TAG,
    TRAVELLED,
    TURN_XX,
    TURN_XY,
    TURN_XZ,
    TURN_YX,
    TURN_YY,
    TURN_YZ,
    TURN_ZX,
    TURN_ZY,
    TURN_ZZ,
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
from dolens.kernels.table import GRAZING


@cache
def _turns(real: types.Type) -> tuple[Any, Any]:
    """Compile R·v and Rᵀ·v, where a record holds R by rows."""

    @njit(**OPTIONS)
    def turn(p, x, y, z):  # noqa: ANN001, ANN202
        return (
            p[TURN_XX] * x + p[TURN_XY] * y + p[TURN_XZ] * z,
            p[TURN_YX] * x + p[TURN_YY] * y + p[TURN_YZ] * z,
            p[TURN_ZX] * x + p[TURN_ZY] * y + p[TURN_ZZ] * z,
        )

    @njit(**OPTIONS)
    def turn_back(p, x, y, z):  # noqa: ANN001, ANN202
        return (
            p[TURN_XX] * x + p[TURN_YX] * y + p[TURN_ZX] * z,
            p[TURN_XY] * x + p[TURN_YY] * y + p[TURN_ZY] * z,
            p[TURN_XZ] * x + p[TURN_YZ] * y + p[TURN_ZZ] * z,
        )

    return turn, turn_back


def change_axes_forward(real: types.Type) -> Callable[..., None]:
    """Carry rays along their line to the level of the next vertex, and turn them.

    Those that run along that level are turned where they are.
    """
    turn, _ = _turns(real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            # Factors, since a branch about the division would stop vectorisation.
            crosses, stays = (one, zero) if math.fabs(n) > grazing else (zero, one)
            cosine = n if n > grazing else grazing
            if n < zero:
                cosine = n if n < -grazing else -grazing
            t = crosses * ((p[STEP_Z] - src[Z + i]) / cosine)
            x, y = src[X + i] - p[STEP_X] + t * l, src[Y + i] - p[STEP_Y] + t * m
            z = stays * (src[Z + i] - p[STEP_Z])
            dst[X + i], dst[Y + i], dst[Z + i] = turn(p, x, y, z)
            dst[L + i], dst[M + i], dst[N + i] = turn(p, l, m, n)
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * t
            dst[ENDED + i], dst[VIGNETTED + i] = src[ENDED + i], src[VIGNETTED + i]
            dst[TRAVELLED + i] = t

    return kernel


def change_axes_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through `change_axes_forward`."""
    _, turn_back = _turns(real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        cot = carray(cotangents, UNBOUNDED)
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            t = dst[TRAVELLED + i]
            crosses, stays = (one, zero) if math.fabs(n) > grazing else (zero, one)
            x, y = src[X + i] - p[STEP_X] + t * l, src[Y + i] - p[STEP_Y] + t * m
            z = stays * (src[Z + i] - p[STEP_Z])
            px, py, pz = cot[X + i], cot[Y + i], cot[Z + i]
            dl, dm, dn = cot[L + i], cot[M + i], cot[N + i]
            cot[OF_TURN_XX + i] = px * x + dl * l
            cot[OF_TURN_XY + i] = px * y + dl * m
            cot[OF_TURN_XZ + i] = px * z + dl * n
            cot[OF_TURN_YX + i] = py * x + dm * l
            cot[OF_TURN_YY + i] = py * y + dm * m
            cot[OF_TURN_YZ + i] = py * z + dm * n
            cot[OF_TURN_ZX + i] = pz * x + dn * l
            cot[OF_TURN_ZY + i] = pz * y + dn * m
            cot[OF_TURN_ZZ + i] = pz * z + dn * n
            qx, qy, qz = turn_back(p, px, py, pz)
            dl, dm, dn = turn_back(p, dl, dm, dn)
            path = cot[PATH + i]
            cosine = n if n > grazing else grazing
            if n < zero:
                cosine = n if n < -grazing else -grazing
            along = crosses * ((qx * l + qy * m + w[INDEX + i] * path) / cosine) - stays * qz
            cot[X + i], cot[Y + i], cot[Z + i] = qx, qy, -along
            cot[L + i], cot[M + i], cot[N + i] = dl + t * qx, dm + t * qy, dn - t * along
            cot[OF_FRONT + i] = path * t
            cot[OF_BEHIND + i] = zero
            cot[OF_STEP_X + i], cot[OF_STEP_Y + i], cot[OF_STEP_Z + i] = -qx, -qy, along

    return kernel


def lens_axes_forward(real: types.Type) -> Callable[..., None]:
    """Transform rays to the lens's axes."""
    turn, _ = _turns(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst, p = carray(before, STATE), carray(after, STATE), carray(record, SHORT_RECORD)
        for i in range(BLOCK):
            x, y, z = turn(p, src[X + i], src[Y + i], src[Z + i])
            dst[X + i], dst[Y + i], dst[Z + i] = x + p[STEP_X], y + p[STEP_Y], z + p[STEP_Z]
            dst[L + i], dst[M + i], dst[N + i] = turn(p, src[L + i], src[M + i], src[N + i])
            path, ended, vignetted = src[PATH + i], src[ENDED + i], src[VIGNETTED + i]
            dst[PATH + i], dst[ENDED + i], dst[VIGNETTED + i] = path, ended, vignetted
            dst[TRAVELLED + i] = zero

    return kernel


def lens_axes_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through `lens_axes_forward`."""
    _, turn_back = _turns(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, p = carray(before, STATE), carray(record, SHORT_RECORD)
        cot = carray(cotangents, UNBOUNDED)
        for i in range(BLOCK):
            x, y, z = src[X + i], src[Y + i], src[Z + i]
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            px, py, pz = cot[X + i], cot[Y + i], cot[Z + i]
            dl, dm, dn = cot[L + i], cot[M + i], cot[N + i]
            cot[OF_STEP_X + i], cot[OF_STEP_Y + i], cot[OF_STEP_Z + i] = px, py, pz
            cot[OF_TURN_XX + i] = px * x + dl * l
            cot[OF_TURN_XY + i] = px * y + dl * m
            cot[OF_TURN_XZ + i] = px * z + dl * n
            cot[OF_TURN_YX + i] = py * x + dm * l
            cot[OF_TURN_YY + i] = py * y + dm * m
            cot[OF_TURN_YZ + i] = py * z + dm * n
            cot[OF_TURN_ZX + i] = pz * x + dn * l
            cot[OF_TURN_ZY + i] = pz * y + dn * m
            cot[OF_TURN_ZZ + i] = pz * z + dn * n
            cot[X + i], cot[Y + i], cot[Z + i] = turn_back(p, px, py, pz)
            cot[L + i], cot[M + i], cot[N + i] = turn_back(p, dl, dm, dn)
            cot[OF_FRONT + i], cot[OF_BEHIND + i] = zero, zero

    return kernel


def sensor_forward(real: types.Type) -> Callable[..., None]:
    """Carry rays to the sensor plane; those that do not travel towards it miss it."""
    zero, missed, grazing = real(0.0), real(MISSED), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        shift, sense, tag = p[SHIFT], p[SENSE], p[TAG]
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            towards = sense * n
            t = -sense * (src[Z + i] + shift) / (towards if towards > grazing else grazing)
            dst[X + i], dst[Y + i], dst[Z + i] = src[X + i] + t * l, src[Y + i] + t * m, zero
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * t
            ended = src[ENDED + i]
            dst[ENDED + i] = ended if ended > zero or towards > grazing else tag + missed
            dst[VIGNETTED + i] = src[VIGNETTED + i]
            dst[TRAVELLED + i] = t

    return kernel
