"""Rays refract at planes."""

from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    EDGE,
    INDEX,
    INVERSE_INDEX,
    LIMIT,
    OF_ARRIVING,
    OF_BEHIND,
    OF_FRONT,
    OF_LEAVING,
    OF_SHIFT,
    PATH,
    RATIO,
    REFRACTS,
    SENSE,
    SENSE_BEHIND,
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


def plane_forward(real: types.Type) -> Callable[..., None]:
    """Carry a block of rays to a plane and through it."""
    _, safe_sqrt, arrive, set_status, *_ = arithmetic(real)
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        shift, limit, sense, tag = p[SHIFT], p[LIMIT], p[SENSE], p[TAG]
        behind = p[SENSE_BEHIND]
        refracts = q[REFRACTS] != 0
        edge = p[EDGE]
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, t, met = arrive(src[X + i], src[Y + i], src[Z + i] + shift, l, m, n, sense, limit)
            dst[X + i], dst[Y + i], dst[Z + i] = x, y, zero
            dst[TRAVELLED + i] = t
            dst[PATH + i] = src[PATH + i] + w[INDEX + i] * t
            ratio = w[RATIO + i]
            squared = (one - ratio * ratio) + (ratio * ratio) * (n * n)
            if refracts:
                l, m, n = ratio * l, ratio * m, behind * safe_sqrt(squared)  # noqa: E741
            else:
                squared = one
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            set_status(src, dst, i, tag, edge, x, y, met, grazing, squared)

    return kernel


def plane_adjoint(real: types.Type, lossy: bool = False) -> Callable[..., None]:
    """Sweep cotangents back through a plane, in place.

    l' = μl, m' = μm, n'² = 1 - μ²(1 - n²); on the plane z = 0 and the distance is -z/n.

    Args:
        real: the precision.
        lossy: add those of the cosines, which are n and n'.
    """
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        refracts = q[REFRACTS] != 0
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            a, b, c = cot[L + i], cot[M + i], cot[N + i]
            if lossy:
                c += w[OF_LEAVING + i]
            of_before = of_behind = zero
            if refracts:
                ratio, behind = w[RATIO + i], dst[N + i]
                of_ratio = a * l + b * m - c * ratio * (one - n * n) / behind
                of_before = of_ratio * ratio * w[INVERSE_INDEX + i]
                of_behind = -of_before * ratio
                a, b, c = ratio * a, ratio * b, ratio * ratio * n / behind * c
            if lossy:
                c += w[OF_ARRIVING + i]
            path, t = cot[PATH + i], dst[TRAVELLED + i]
            x, y = cot[X + i], cot[Y + i]
            z = -(x * l + y * m + w[INDEX + i] * path) / n
            cot[Z + i] = z
            cot[L + i], cot[M + i], cot[N + i] = a + t * x, b + t * y, c + t * z
            cot[OF_FRONT + i] = of_before + path * t
            cot[OF_BEHIND + i] = of_behind
            cot[OF_SHIFT + i] = z

    return kernel


def lossy_plane_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a plane that loses light, in place."""
    return plane_adjoint(real, True)
