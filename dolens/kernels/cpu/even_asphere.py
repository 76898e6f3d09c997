"""Even aspheres, s = conic + q²·H(q) with q = r² and H = a4 + a6·q + ..., by Horner's rule.

Coefficients come in groups of four, so that four steps are unrolled at a time.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS, shifted


@cache
def _horner(real: types.Type) -> tuple[Any, Any]:
    """Compiled: H and H' (and H''/2) of a block into work rows 17, 18 (and 19); q into row 16."""
    zero = real(0.0)

    @njit(**OPTIONS)
    def first(w, record, count):  # noqa: ANN001, ANN202
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            w[2048 + i] = x * x + y * y
            w[2176 + i], w[2304 + i] = zero, zero
        for group in range(count // 4 - 1, -1, -1):
            a = carray(shifted(record, 26 + 4 * group), 4)
            a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
            for i in range(128):
                q, h, d = w[2048 + i], w[2176 + i], w[2304 + i]
                d, h = d * q + h, h * q + a3
                d, h = d * q + h, h * q + a2
                d, h = d * q + h, h * q + a1
                w[2304 + i], w[2176 + i] = d * q + h, h * q + a0

    @njit(**OPTIONS)
    def second(w, record, count):  # noqa: ANN001, ANN202
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            w[2048 + i] = x * x + y * y
            w[2176 + i], w[2304 + i], w[2432 + i] = zero, zero, zero
        for group in range(count // 4 - 1, -1, -1):
            a = carray(shifted(record, 26 + 4 * group), 4)
            a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
            for i in range(128):
                q, h, d, e = w[2048 + i], w[2176 + i], w[2304 + i], w[2432 + i]
                e, d, h = e * q + d, d * q + h, h * q + a3
                e, d, h = e * q + d, d * q + h, h * q + a2
                e, d, h = e * q + d, d * q + h, h * q + a1
                w[2432 + i], w[2304 + i], w[2176 + i] = e * q + d, d * q + h, h * q + a0

    return first, second


def even_asphere_sag(real: types.Type) -> Callable[..., None]:
    """Sag, slopes, and the margin of the conic's branch."""
    _, safe_sqrt, *_ = arithmetic(real)
    horner, _ = _horner(real)
    one, two = real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, count = carray(record, 32), carray(work, 6144), carray(codes, 24)[8]
        horner(w, record, count)
        c = p[24]
        ec2 = (one + p[25]) * c * c
        for i in range(128):
            q, h, d = w[2048 + i], w[2176 + i], w[2304 + i]
            squared = one - ec2 * q
            root = safe_sqrt(squared)
            both = c / (root * (one + root))
            twice = both * (one + root) + two * q * (two * h + q * d)
            w[512 + i] = both * root * q + q * q * h
            w[640 + i], w[768 + i] = w[256 + i] * twice, w[384 + i] * twice
            w[896 + i] = squared

    return kernel


def even_asphere_bend(real: types.Type) -> Callable[..., None]:
    """Slopes and second derivatives: with f(q), s_xx = 2f' + 4x²f'', s_xy = 4xyf''."""
    _, safe_sqrt, *_ = arithmetic(real)
    _, horner = _horner(real)
    half, one, two, four = real(0.5), real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, count = carray(record, 32), carray(work, 6144), carray(codes, 24)[8]
        horner(w, record, count)
        c = p[24]
        ec2 = (one + p[25]) * c * c
        for i in range(128):
            x, y, q = w[256 + i], w[384 + i], w[2048 + i]
            h, d, e = w[2176 + i], w[2304 + i], w[2432 + i]
            root = safe_sqrt(one - ec2 * q)
            conic = half * c / root
            slope = conic + q * (two * h + q * d)
            bend = half * conic * ec2 / (root * root) + two * h + four * q * d + two * q * q * e
            w[640 + i], w[768 + i] = two * x * slope, two * y * slope
            w[1024 + i] = two * slope + four * x * x * bend
            w[1152 + i] = four * x * y * bend
            w[1280 + i] = two * slope + four * y * y * bend

    return kernel


def even_asphere_parameters(real: types.Type) -> Callable[..., None]:
    """Cotangents of c, k and the coefficients.

    With R = √(1 - (1+k)c²q): s_c = (q + (1+k)s²)/2R and s_k = c·s²/2R of the conic's sag s, and of
    its derivative in q, c/2R: 1/2R³ and c³q/4R³.
    """
    _, safe_sqrt, *_ = arithmetic(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, count = carray(record, 32), carray(work, 6144), carray(codes, 24)[8]
        cot = carray(cotangents, 5376)
        c, e = p[24], one + p[25]
        for i in range(128):
            x, y, q = w[256 + i], w[384 + i], w[2048 + i]
            of_sag = w[1408 + i]
            of_slope = two * (w[1536 + i] * x + w[1664 + i] * y)
            inverse = one / safe_sqrt(one - e * c * c * q)
            sag = c * q / (one + one / inverse)
            cubed = half * of_slope * inverse * inverse * inverse
            cot[5120 + i] = half * of_sag * inverse * (q + e * sag * sag) + cubed
            cot[5248 + i] = half * c * (of_sag * inverse * sag * sag + c * c * q * cubed)
            # From here on: q^(j+1) and the weights of q^(j+2) and its derivative.
            w[2176 + i], w[2304 + i] = q, of_slope
        for j in range(count):
            out = carray(shifted(cotangents, 5376 + 128 * j), 128)
            power = real(j + 2)
            for i in range(128):
                q, lower = w[2048 + i], w[2176 + i]
                upper = lower * q
                out[i] = w[1408 + i] * upper + power * w[2304 + i] * lower
                w[2176 + i] = upper

    return kernel
