"""XY polynomials with the implicit b·z² term; see `dolens.optics.surfaces.xy_polynomial`.

With P = Σ a·x^i·y^j and W = √(1 - 4bP): s = 2P/(1 + W), s_x = P_x/W.

Up to the third degree, a phase plate's, P is a dense polynomial by Horner's rule; beyond, a sum
over the terms that there are.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, shifted

# Rows of powers begin here; x^d is row 48 + d, and y^d follows at 49 + degree + d.


@cache
def _polynomial(real: types.Type) -> tuple[Any, Any, Any]:
    """Compiled: powers of a block; P and its slopes (rows 4 to 6); its second derivatives."""
    zero, one, two, three = real(0.0), real(1.0), real(2.0), real(3.0)

    @njit(**OPTIONS)
    def total_degree(extras, count):  # noqa: ANN001, ANN202
        highest = 0
        for t in range(count):
            highest = max(highest, extras[2 * t] + extras[2 * t + 1])
        return highest

    @njit(**OPTIONS)
    def powers(work, degree):  # noqa: ANN001, ANN202
        for axis in range(2):
            u = carray(shifted(work, 256 + 128 * axis), 128)
            base = shifted(work, 6144 + 128 * axis * (degree + 1))
            row = carray(base, 128)
            for i in range(128):
                row[i] = one
            for d in range(degree):
                lower = carray(shifted(base, 128 * d), 128)
                upper = carray(shifted(base, 128 * (d + 1)), 128)
                for i in range(128):
                    upper[i] = lower[i] * u[i]

    @njit(**OPTIONS)
    def accumulate(work, degree, row, a, i, j):  # noqa: ANN001, ANN202
        """Add a·x^i·y^j to a work row."""
        if a == zero:
            return
        out = carray(shifted(work, 128 * row), 128)
        u = carray(shifted(work, 6144 + 128 * i), 128)
        v = carray(shifted(work, 6144 + 128 * (degree + 1 + j)), 128)
        for k in range(128):
            out[k] += a * (u[k] * v[k])

    @njit(**OPTIONS)
    def cubic_slopes(work, p, extras, count):  # noqa: ANN001, ANN202
        """P and its slopes, with every coefficient in a register."""
        w, a = carray(work, 6144), carray(shifted(work, 3328), 16)
        for k in range(16):
            a[k] = zero
        for t in range(count):
            a[4 * extras[2 * t] + extras[2 * t + 1]] += p[25 + t]
        a00, a01, a02, a03 = a[0], a[1], a[2], a[3]
        a10, a11, a12, a20, a21, a30 = a[4], a[5], a[6], a[8], a[9], a[12]
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            # Coefficients of x⁰, x¹ and x² at this y.
            b0 = ((a03 * y + a02) * y + a01) * y + a00
            b1 = (a12 * y + a11) * y + a10
            b2 = a21 * y + a20
            w[512 + i] = ((a30 * x + b2) * x + b1) * x + b0
            w[640 + i] = (three * a30 * x + two * b2) * x + b1
            d0 = (three * a03 * y + two * a02) * y + a01
            d1 = two * a12 * y + a11
            w[768 + i] = (a21 * x + d1) * x + d0

    @njit(**OPTIONS)
    def slopes(work, p, extras, count, degree):  # noqa: ANN001, ANN202
        if total_degree(extras, count) <= 3:
            cubic_slopes(work, p, extras, count)
            return
        w = carray(work, 6144)
        powers(work, degree)
        for i in range(128):
            w[512 + i], w[640 + i], w[768 + i] = zero, zero, zero
        for t in range(count):
            a, i, j = p[25 + t], extras[2 * t], extras[2 * t + 1]
            accumulate(work, degree, 4, a, i, j)
            if i > 0:
                accumulate(work, degree, 5, a * real(i), i - 1, j)
            if j > 0:
                accumulate(work, degree, 6, a * real(j), i, j - 1)

    @njit(**OPTIONS)
    def bends(work, p, extras, count, degree):  # noqa: ANN001, ANN202
        w = carray(work, 6144)
        for i in range(128):
            w[1024 + i], w[1152 + i], w[1280 + i] = zero, zero, zero
        for t in range(count):
            a, i, j = p[25 + t], extras[2 * t], extras[2 * t + 1]
            if i > 1:
                accumulate(work, degree, 8, a * real(i * (i - 1)), i - 2, j)
            if i > 0 and j > 0:
                accumulate(work, degree, 9, a * real(i * j), i - 1, j - 1)
            if j > 1:
                accumulate(work, degree, 10, a * real(j * (j - 1)), i, j - 2)

    return powers, slopes, bends


def xy_polynomial_sag(real: types.Type) -> Callable[..., None]:
    """Sag, slopes, and the margin 1 - 4bP of the branch through the vertex."""
    _, safe_sqrt, *_ = arithmetic(real)
    _, slopes, _ = _polynomial(real)
    one, two, four = real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, 1 << 40), carray(work, 6144), carray(codes, 24)
        extras = carray(int64_at(q[21]), 1 << 40)
        slopes(work, p, extras, q[8], q[11])
        if q[9] == 0:
            for i in range(128):
                w[896 + i] = one
            return
        b = p[24]
        for i in range(128):
            squared = one - four * b * w[512 + i]
            root = safe_sqrt(squared)
            w[512 + i] = two * w[512 + i] / (one + root)
            w[640 + i] = w[640 + i] / root
            w[768 + i] = w[768 + i] / root
            w[896 + i] = squared

    return kernel


def xy_polynomial_bend(real: types.Type) -> Callable[..., None]:
    """Slopes and second derivatives: s_xy = P_xy/W + 2b·P_x·P_y/W³.

    Rows 20, 21 and 22 keep W, P_x and P_y for the cotangents of the coefficients.
    """
    _, safe_sqrt, *_ = arithmetic(real)
    powers, slopes, bends = _polynomial(real)
    one, two, four = real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, 1 << 40), carray(work, 6144), carray(codes, 24)
        extras = carray(int64_at(q[21]), 1 << 40)
        powers(work, q[11])
        slopes(work, p, extras, q[8], q[11])
        bends(work, p, extras, q[8], q[11])
        if q[9] == 0:
            return
        b = p[24]
        for i in range(128):
            root = safe_sqrt(one - four * b * w[512 + i])
            inverse = one / root
            px, py = w[640 + i], w[768 + i]
            bend = two * b * inverse * inverse * inverse
            w[2560 + i], w[2688 + i], w[2816 + i] = root, px, py
            w[640 + i], w[768 + i] = px * inverse, py * inverse
            w[1024 + i] = w[1024 + i] * inverse + bend * px * px
            w[1152 + i] = w[1152 + i] * inverse + bend * px * py
            w[1280 + i] = w[1280 + i] * inverse + bend * py * py

    return kernel


def xy_polynomial_parameters(real: types.Type) -> Callable[..., None]:
    """Cotangents of b and the coefficients.

    Those of P, P_x and P_y first: s_P = 1/W, ∂s_x/∂P = 2b·P_x/W³; and with b, s_b = s²/W and
    ∂s_x/∂b = 2P·P_x/W³.
    """
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, 1 << 40), carray(work, 6144), carray(codes, 24)
        cot = carray(cotangents, 6144)
        extras = carray(int64_at(q[21]), 1 << 40)
        count, degree = q[8], q[11]
        if q[9] == 0:
            for i in range(128):
                cot[5120 + i] = zero
        else:
            b = p[24]
            for i in range(128):
                value, root, px, py = w[512 + i], w[2560 + i], w[2688 + i], w[2816 + i]
                of_sag, of_sx, of_sy = w[1408 + i], w[1536 + i], w[1664 + i]
                inverse = one / root
                cubed = two * inverse * inverse * inverse * (of_sx * px + of_sy * py)
                sag = two * value / (one + root)
                cot[5120 + i] = of_sag * sag * sag * inverse + value * cubed
                w[1408 + i] = of_sag * inverse + b * cubed
                w[1536 + i], w[1664 + i] = of_sx * inverse, of_sy * inverse
        for t in range(count):
            i, j = extras[2 * t], extras[2 * t + 1]
            out = carray(shifted(cotangents, 5248 + 128 * t), 128)
            u = carray(shifted(work, 6144 + 128 * i), 128)
            v = carray(shifted(work, 6144 + 128 * (degree + 1 + j)), 128)
            of_sag = carray(shifted(work, 1408), 128)
            for k in range(128):
                out[k] = of_sag[k] * u[k] * v[k]
            if i > 0:
                lower = carray(shifted(work, 6144 + 128 * (i - 1)), 128)
                of_sx, power = carray(shifted(work, 1536), 128), real(i)
                for k in range(128):
                    out[k] += power * of_sx[k] * lower[k] * v[k]
            if j > 0:
                lower = carray(shifted(work, 6144 + 128 * (degree + j)), 128)
                of_sy, power = carray(shifted(work, 1664), 128), real(j)
                for k in range(128):
                    out[k] += power * of_sy[k] * u[k] * lower[k]

    return kernel
