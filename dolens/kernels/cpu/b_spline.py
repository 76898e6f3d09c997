"""A cubic B-spline surface is evaluated by its local stencil; see
`dolens.optics.surfaces.b_spline`.

The record holds the knots in x, the knots in y, and the coefficients, rows along y.

Each ray needs six knots of either axis and 16 coefficients.  They are copied to work rows when the
ray's span changes, which between Newton's steps is seldom; the arithmetic then runs over rows.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    COLUMNS,
    COUNT,
    FURTHER,
    MARGIN,
    OF_SAG,
    OF_SHAPE,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SHAPE,
    SLOPE_X,
    SLOPE_Y,
    STENCIL_IS_HERE,
    STENCIL_PLACE,
    UNBOUNDED,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.cubics import b_splines, b_splines_second

MORE_KNOTS = 4  # than coefficients
# Work rows: the knots about x and about y, and the coefficients, four rows of four; then the first
# column and row of these.
STENCIL_ROWS = 30
FOUR = 4 * BLOCK
XA, XB, XC, XD, XE, XF, YA, YB, YC, YD, YE, YF, C0, C1, C2, C3 = (
    FURTHER + BLOCK * row for row in range(16)
)
LEVEL = C0 + FOUR + BLOCK  # a coefficient in the middle, which is taken off the others
FIRST_COLUMN, FIRST_ROW = C0 + 4 * FOUR, C0 + 4 * FOUR + BLOCK


class Spline(NamedTuple):
    """These compiled functions belong to one real type."""

    fetch: Any
    basis: Any
    second_derivatives: Any


@cache
def _spline(real: types.Type) -> Spline:
    zero, one = real(0.0), real(1.0)

    @njit(**OPTIONS)
    def span(knots, count, u):  # noqa: ANN001, ANN202
        """Return the first of the four coefficients that matter at u, from 0 to count - 4."""
        last = count - 4
        low, high = knots[3], knots[count]
        if not u > low:
            first = types.int64(0)
        elif not u < high:
            first = last
        else:
            # Knots are nearly even as a rule: guess, and walk.
            first = min(types.int64((u - low) / (high - low) * real(last + 1)), last)
            while first > 0 and u < knots[first + 3]:
                first -= 1
        while first < last and u >= knots[first + 4]:
            first += 1
        return first

    @njit(**OPTIONS)
    def fetch(record, work, rows, columns):  # noqa: ANN001, ANN202
        """Bring every ray's knots and coefficients to its lane, where they are not there yet."""
        w = carray(work, UNBOUNDED)
        if w[STENCIL_IS_HERE] == one:
            outside = zero
            for i in range(BLOCK):
                x, y = w[POINT_X + i], w[POINT_Y + i]
                here = x >= w[XC + i] and x < w[XD + i] and y >= w[YC + i] and y < w[YD + i]
                outside += zero if here else one
            if outside == zero:
                return
        w[STENCIL_IS_HERE] = one
        knots_x = carray(shifted(record, SHAPE), UNBOUNDED)
        knots_y = carray(shifted(record, SHAPE + MORE_KNOTS + columns), UNBOUNDED)
        coefficients = shifted(record, SHAPE + 2 * MORE_KNOTS + columns + rows)
        for i in range(BLOCK):
            column = span(knots_x, columns, w[POINT_X + i])
            row = span(knots_y, rows, w[POINT_Y + i])
            around_x = carray(shifted(record, SHAPE + 1 + column), 8)
            around_y = carray(shifted(record, SHAPE + MORE_KNOTS + 1 + columns + row), 8)
            for k in range(6):
                w[XA + BLOCK * k + i] = around_x[k]
                w[YA + BLOCK * k + i] = around_y[k]
            first = shifted(coefficients, row * columns + column)
            for j in range(4):
                c = carray(shifted(first, j * columns), 4)
                for k in range(4):
                    w[C0 + BLOCK * (4 * j + k) + i] = c[k]
            w[FIRST_COLUMN + i], w[FIRST_ROW + i] = real(column), real(row)

    basis, second_derivatives = (
        scalar(function, real, "always") for function in (b_splines, b_splines_second)
    )
    return Spline(fetch, basis, second_derivatives)


def b_spline_sag(real: types.Type) -> Callable[..., None]:
    """Fill the rows of sag, slopes, and the distance to the nearest edge of the knot rectangle."""
    fetch, basis, _ = _spline(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        rows, columns = q[COUNT], q[COLUMNS]
        knots_x = carray(shifted(record, SHAPE), UNBOUNDED)
        knots_y = carray(shifted(record, SHAPE + MORE_KNOTS + columns), UNBOUNDED)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        fetch(record, work, rows, columns)
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            bx = basis(
                w[XA + i], w[XB + i], w[XC + i], w[XD + i], w[XE + i], w[XF + i],
                x, x_low, x_high,
            )  # fmt: skip
            by = basis(
                w[YA + i], w[YB + i], w[YC + i], w[YD + i], w[YE + i], w[YF + i],
                y, y_low, y_high,
            )  # fmt: skip
            level = w[LEVEL + i]
            s = sx = sy = zero
            for j in range(4):
                c0, c1 = w[C0 + FOUR * j + i] - level, w[C1 + FOUR * j + i] - level
                c2, c3 = w[C2 + FOUR * j + i] - level, w[C3 + FOUR * j + i] - level
                along = c0 * bx[0] + c1 * bx[1] + c2 * bx[2] + c3 * bx[3]
                slope = c0 * bx[4] + c1 * bx[5] + c2 * bx[6] + c3 * bx[7]
                s += along * by[j]
                sx += slope * by[j]
                sy += along * by[4 + j]
            w[SAG + i], w[SLOPE_X + i], w[SLOPE_Y + i] = level + s, sx, sy
            left, right, below, above = x - x_low, x_high - x, y - y_low, y_high - y
            left = right if right < left else left
            below = above if above < below else below
            w[MARGIN + i] = below if below < left else left

    return kernel


def b_spline_hessian(real: types.Type) -> Callable[..., None]:
    """Fill the rows of slopes and second derivatives."""
    fetch, basis, second_derivatives = _spline(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        rows, columns = q[COUNT], q[COLUMNS]
        knots_x = carray(shifted(record, SHAPE), UNBOUNDED)
        knots_y = carray(shifted(record, SHAPE + MORE_KNOTS + columns), UNBOUNDED)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        w[STENCIL_IS_HERE] = zero
        fetch(record, work, rows, columns)
        for i in range(BLOCK):
            x, y = w[POINT_X + i], w[POINT_Y + i]
            xa, xb, xc = w[XA + i], w[XB + i], w[XC + i]
            xd, xe, xf = w[XD + i], w[XE + i], w[XF + i]
            ya, yb, yc = w[YA + i], w[YB + i], w[YC + i]
            yd, ye, yf = w[YD + i], w[YE + i], w[YF + i]
            bx = basis(xa, xb, xc, xd, xe, xf, x, x_low, x_high)
            by = basis(ya, yb, yc, yd, ye, yf, y, y_low, y_high)
            ex = second_derivatives(xa, xb, xc, xd, xe, xf, x, x_low, x_high)
            ey = second_derivatives(ya, yb, yc, yd, ye, yf, y, y_low, y_high)
            level = w[LEVEL + i]
            sx = sy = sxx = sxy = syy = zero
            for j in range(4):
                c0, c1 = w[C0 + FOUR * j + i] - level, w[C1 + FOUR * j + i] - level
                c2, c3 = w[C2 + FOUR * j + i] - level, w[C3 + FOUR * j + i] - level
                along = c0 * bx[0] + c1 * bx[1] + c2 * bx[2] + c3 * bx[3]
                slope = c0 * bx[4] + c1 * bx[5] + c2 * bx[6] + c3 * bx[7]
                curve = c0 * ex[0] + c1 * ex[1] + c2 * ex[2] + c3 * ex[3]
                sx += slope * by[j]
                sy += along * by[4 + j]
                sxx += curve * by[j]
                sxy += slope * by[4 + j]
                syy += along * ey[j]
            w[SLOPE_X + i], w[SLOPE_Y + i] = sx, sy
            w[SAG_XX + i], w[SAG_XY + i], w[SAG_YY + i] = sxx, sxy, syy

    return kernel


def b_spline_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of each ray's 16 coefficients, and where these lie.

    The place counts from the record's first coefficient.  `b_spline_hessian` has fetched the knots.
    """
    _, basis, _ = _spline(real)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        rows, columns = q[COUNT], q[COLUMNS]
        cot = carray(cotangents, UNBOUNDED)
        knots_x = carray(shifted(record, SHAPE), UNBOUNDED)
        knots_y = carray(shifted(record, SHAPE + MORE_KNOTS + columns), UNBOUNDED)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        width = real(columns)
        for i in range(BLOCK):
            of_sag, of_sx, of_sy = w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i]
            bx = basis(
                w[XA + i], w[XB + i], w[XC + i], w[XD + i], w[XE + i], w[XF + i],
                w[POINT_X + i], x_low, x_high,
            )  # fmt: skip
            by = basis(
                w[YA + i], w[YB + i], w[YC + i], w[YD + i], w[YE + i], w[YF + i],
                w[POINT_Y + i], y_low, y_high,
            )  # fmt: skip
            for j in range(4):
                along, across = of_sag * by[j] + of_sy * by[4 + j], of_sx * by[j]
                for k in range(4):
                    cot[OF_SHAPE + BLOCK * (4 * j + k) + i] = along * bx[k] + across * bx[4 + k]
            cot[STENCIL_PLACE + i] = w[FIRST_ROW + i] * width + w[FIRST_COLUMN + i]

    return kernel


def _rows_of_stencil(row: Sequence[int]) -> int:
    """Return the number of rows for each ray's knots and coefficients."""
    return STENCIL_ROWS


KERNELS = given_by_sag(
    b_spline_sag, b_spline_hessian, b_spline_parameters, stencil=True, scratch=_rows_of_stencil
)
