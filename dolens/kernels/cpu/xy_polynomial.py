"""An XY polynomial may have the implicit b·z² term; see `dolens.optics.surfaces.xy_polynomial`.

With P = Σ a·x^i·y^j and W = √(1 - 4bP): s = 2P/(1 + W), s_x = P_x/W.

Up to the third degree, a phase plate's, P is a dense polynomial by Horner's rule; beyond, a sum
over the terms that there are.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.arithmetic import arithmetic
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    COLUMNS,
    COUNT,
    CUBIC,
    DEGREE,
    EXTRAS_ADDRESS,
    FURTHER,
    MARGIN,
    OF_SAG,
    OF_SECOND,
    OF_SHAPE,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    OWN,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SHAPE,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
    WORK_SIZE,
)

# Work rows: W, P_x and P_y; then the powers of x from the zeroth to the degree, and those of y.
ROOT, P_X, P_Y = OWN[-4:-1]
POWERS = FURTHER
COEFFICIENTS, OF_COEFFICIENTS = SHAPE + 1, OF_SECOND  # behind b


@cache
def _polynomial(real: types.Type) -> tuple[Any, Any, Any]:
    """Compile the powers of a block, P with its slopes, and P's second derivatives."""
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
            u = carray(shifted(work, POINT_X + BLOCK * axis), BLOCK)
            base = shifted(work, POWERS + BLOCK * axis * (degree + 1))
            row = carray(base, BLOCK)
            for i in range(BLOCK):
                row[i] = one
            for d in range(degree):
                lower = carray(shifted(base, BLOCK * d), BLOCK)
                upper = carray(shifted(base, BLOCK * (d + 1)), BLOCK)
                for i in range(BLOCK):
                    upper[i] = lower[i] * u[i]

    @njit(**OPTIONS)
    def accumulate(work, degree, row, a, i, j):  # noqa: ANN001, ANN202
        """Add a·x^i·y^j to a work row."""
        if a == zero:
            return
        out = carray(shifted(work, row), BLOCK)
        u = carray(shifted(work, POWERS + BLOCK * i), BLOCK)
        v = carray(shifted(work, POWERS + BLOCK * (degree + 1 + j)), BLOCK)
        for k in range(BLOCK):
            out[k] += a * (u[k] * v[k])

    @njit(**OPTIONS)
    def cubic_slopes(work, p, extras, count):  # noqa: ANN001, ANN202
        """Fill the rows of P and its slopes, with every coefficient in a register."""
        w, a = carray(work, WORK_SIZE), carray(shifted(work, CUBIC), 16)
        for k in range(16):
            a[k] = zero
        for t in range(count):
            a[4 * extras[2 * t] + extras[2 * t + 1]] += p[COEFFICIENTS + t]
        a00, a01, a02, a03 = a[0], a[1], a[2], a[3]
        a10, a11, a12, a20, a21, a30 = a[4], a[5], a[6], a[8], a[9], a[12]
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            # Coefficients of x⁰, x¹ and x² at this y.
            b0 = ((a03 * y + a02) * y + a01) * y + a00
            b1 = (a12 * y + a11) * y + a10
            b2 = a21 * y + a20
            w[SAG + i] = ((a30 * x + b2) * x + b1) * x + b0
            w[SLOPE_X + i] = (three * a30 * x + two * b2) * x + b1
            d0 = (three * a03 * y + two * a02) * y + a01
            d1 = two * a12 * y + a11
            w[SLOPE_Y + i] = (a21 * x + d1) * x + d0

    @njit(**OPTIONS)
    def slopes(work, p, extras, count, degree):  # noqa: ANN001, ANN202
        if total_degree(extras, count) <= 3:
            cubic_slopes(work, p, extras, count)
            return
        w = carray(work, WORK_SIZE)
        powers(work, degree)
        for i in range(BLOCK):
            w[SAG + i], w[SLOPE_X + i], w[SLOPE_Y + i] = zero, zero, zero
        for t in range(count):
            a, i, j = p[COEFFICIENTS + t], extras[2 * t], extras[2 * t + 1]
            accumulate(work, degree, SAG, a, i, j)
            if i > 0:
                accumulate(work, degree, SLOPE_X, a * real(i), i - 1, j)
            if j > 0:
                accumulate(work, degree, SLOPE_Y, a * real(j), i, j - 1)

    @njit(**OPTIONS)
    def second_derivatives(work, p, extras, count, degree):  # noqa: ANN001, ANN202
        w = carray(work, WORK_SIZE)
        for i in range(BLOCK):
            w[SAG_XX + i], w[SAG_XY + i], w[SAG_YY + i] = zero, zero, zero
        for t in range(count):
            a, i, j = p[COEFFICIENTS + t], extras[2 * t], extras[2 * t + 1]
            if i > 1:
                accumulate(work, degree, SAG_XX, a * real(i * (i - 1)), i - 2, j)
            if i > 0 and j > 0:
                accumulate(work, degree, SAG_XY, a * real(i * j), i - 1, j - 1)
            if j > 1:
                accumulate(work, degree, SAG_YY, a * real(j * (j - 1)), i, j - 2)

    return powers, slopes, second_derivatives


def xy_polynomial_sag(real: types.Type) -> Callable[..., None]:
    """Fill the rows of sag, slopes, and the margin 1 - 4bP of the branch through the vertex."""
    _, safe_sqrt, *_ = arithmetic(real)
    _, slopes, _ = _polynomial(real)
    one, two, four = real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, UNBOUNDED), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        slopes(work, p, extras, q[COUNT], q[DEGREE])
        if q[COLUMNS] == 0:
            for i in range(BLOCK):
                w[MARGIN + i] = one
            return
        b = p[SHAPE]
        for i in range(BLOCK):
            squared = one - four * b * w[SAG + i]
            root = safe_sqrt(squared)
            w[SAG + i] = two * w[SAG + i] / (one + root)
            w[SLOPE_X + i] = w[SLOPE_X + i] / root
            w[SLOPE_Y + i] = w[SLOPE_Y + i] / root
            w[MARGIN + i] = squared

    return kernel


def xy_polynomial_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of slopes and second derivatives: s_xy = P_xy/W + 2b·P_x·P_y/W³.

    Rows 20, 21 and 22 keep W, P_x and P_y for the cotangents of the coefficients.
    """
    _, safe_sqrt, *_ = arithmetic(real)
    powers, slopes, second_derivatives = _polynomial(real)
    one, two, four = real(1.0), real(2.0), real(4.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, UNBOUNDED), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        powers(work, q[DEGREE])
        slopes(work, p, extras, q[COUNT], q[DEGREE])
        second_derivatives(work, p, extras, q[COUNT], q[DEGREE])
        if q[COLUMNS] == 0:
            return
        b = p[SHAPE]
        for i in range(BLOCK):
            root = safe_sqrt(one - four * b * w[SAG + i])
            inverse = one / root
            px, py = w[SLOPE_X + i], w[SLOPE_Y + i]
            factor = two * b * inverse * inverse * inverse
            w[ROOT + i], w[P_X + i], w[P_Y + i] = root, px, py
            w[SLOPE_X + i], w[SLOPE_Y + i] = px * inverse, py * inverse
            w[SAG_XX + i] = w[SAG_XX + i] * inverse + factor * px * px
            w[SAG_XY + i] = w[SAG_XY + i] * inverse + factor * px * py
            w[SAG_YY + i] = w[SAG_YY + i] * inverse + factor * py * py

    return kernel


def xy_polynomial_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of b and the coefficients.

    Those of P, P_x and P_y first: s_P = 1/W, ∂s_x/∂P = 2b·P_x/W³; and with b, s_b = s²/W and
    ∂s_x/∂b = 2P·P_x/W³.
    """
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        p, w, q = carray(record, UNBOUNDED), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        extras = carray(int64_at(q[EXTRAS_ADDRESS]), UNBOUNDED)
        count, degree = q[COUNT], q[DEGREE]
        if q[COLUMNS] == 0:
            for i in range(BLOCK):
                cot[OF_SHAPE + i] = zero
        else:
            b = p[SHAPE]
            for i in range(BLOCK):
                value, root, px, py = w[SAG + i], w[ROOT + i], w[P_X + i], w[P_Y + i]
                of_sag, of_sx, of_sy = w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i]
                inverse = one / root
                cubed = two * inverse * inverse * inverse * (of_sx * px + of_sy * py)
                sag = two * value / (one + root)
                cot[OF_SHAPE + i] = of_sag * sag * sag * inverse + value * cubed
                w[OF_SAG + i] = of_sag * inverse + b * cubed
                w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i] = of_sx * inverse, of_sy * inverse
        for t in range(count):
            i, j = extras[2 * t], extras[2 * t + 1]
            out = carray(shifted(cotangents, OF_COEFFICIENTS + BLOCK * t), BLOCK)
            u = carray(shifted(work, POWERS + BLOCK * i), BLOCK)
            v = carray(shifted(work, POWERS + BLOCK * (degree + 1 + j)), BLOCK)
            of_sag = carray(shifted(work, OF_SAG), BLOCK)
            for k in range(BLOCK):
                out[k] = of_sag[k] * u[k] * v[k]
            if i > 0:
                lower = carray(shifted(work, POWERS + BLOCK * (i - 1)), BLOCK)
                of_sx, power = carray(shifted(work, OF_SLOPE_X), BLOCK), real(i)
                for k in range(BLOCK):
                    out[k] += power * of_sx[k] * lower[k] * v[k]
            if j > 0:
                lower = carray(shifted(work, POWERS + BLOCK * (degree + j)), BLOCK)
                of_sy, power = carray(shifted(work, OF_SLOPE_Y), BLOCK), real(j)
                for k in range(BLOCK):
                    out[k] += power * of_sy[k] * u[k] * lower[k]

    return kernel


def _rows_of_powers(row: Sequence[int]) -> int:
    """Return the number of rows for the powers of x and y."""
    return 2 * (int(row[DEGREE]) + 1)


KERNELS = given_by_sag(
    xy_polynomial_sag, xy_polynomial_hessian, xy_polynomial_parameters, scratch=_rows_of_powers
)
