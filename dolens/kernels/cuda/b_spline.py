"""A cubic B-spline surface is evaluated by its local stencil; see
`dolens.optics.surfaces.b_spline`.

The record holds the knots in x, the knots in y, and the coefficients, rows along y.
"""

import triton
import triton.language as tl

from dolens.kernels import cubics
from dolens.kernels.cuda.arithmetic import add_sum, first_of
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COLUMNS, COUNT, SHAPE
from dolens.kernels.cuda.translation import compiled

MORE_KNOTS = tl.constexpr(4)  # than coefficients
b_splines, b_splines_second = compiled(cubics.b_splines), compiled(cubics.b_splines_second)


@triton.jit
def _span(knots, count, u):
    """Return the first of the four coefficients that matter at u, from 0 to count - 4, by
    bisection.
    """
    low = tl.zeros(u.shape, tl.int32)
    high = low + (count - MORE_KNOTS)
    width = count - MORE_KNOTS
    while width > 0:
        middle = (low + high) // 2
        beyond = (u >= tl.load(knots + middle + MORE_KNOTS)) & (low < high)
        low = tl.where(beyond, middle + 1, low)
        high = tl.where(beyond, high, middle)
        width = width // 2
    return low


@triton.jit
def _basis(around, u, low, high):
    """Return values and slopes of four basis functions; `around` points to the knots about the
    span.
    """
    a, b, c = tl.load(around + 1), tl.load(around + 2), tl.load(around + 3)
    d, e, f = tl.load(around + 4), tl.load(around + 5), tl.load(around + 6)
    return b_splines(a, b, c, d, e, f, u, low, high)


@triton.jit
def _second_derivatives(around, u, low, high):
    """Return the second derivatives of the four; zero beyond the ends."""
    a, b, c = tl.load(around + 1), tl.load(around + 2), tl.load(around + 3)
    d, e, f = tl.load(around + 4), tl.load(around + 5), tl.load(around + 6)
    return b_splines_second(a, b, c, d, e, f, u, low, high)


@triton.jit
def _stencil(record, codes, x, y):
    """Return the places of the knots and coefficients about each point, and the knot rectangle's
    edges.
    """
    rows, columns = tl.load(codes + COUNT), tl.load(codes + COLUMNS)
    knots_x = record + SHAPE
    knots_y = knots_x + columns + MORE_KNOTS
    column, row = _span(knots_x, columns, x), _span(knots_y, rows, y)
    return (
        columns,
        knots_x + column,
        knots_y + row,
        row * columns + column,
        knots_y + rows + MORE_KNOTS,
        tl.load(knots_x + 3),
        tl.load(knots_x + columns),
        tl.load(knots_y + 3),
        tl.load(knots_y + rows),
    )


@triton.jit
def b_spline_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the distance to the nearest edge of the knot rectangle."""
    columns, near_x, near_y, place, coefficients, x_low, x_high, y_low, y_high = _stencil(
        record, codes, x, y
    )
    bx0, bx1, bx2, bx3, dx0, dx1, dx2, dx3 = _basis(near_x, x, x_low, x_high)
    by0, by1, by2, by3, dy0, dy1, dy2, dy3 = _basis(near_y, y, y_low, y_high)
    first = coefficients + place
    level = tl.load(first + columns + 1)
    s, sx, sy = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for j in tl.static_range(4):
        weight = (by0, by1, by2, by3)[j]
        row = first + j * columns
        c0, c1 = tl.load(row) - level, tl.load(row + 1) - level
        c2, c3 = tl.load(row + 2) - level, tl.load(row + 3) - level
        along = c0 * bx0 + c1 * bx1 + c2 * bx2 + c3 * bx3
        s += along * weight
        sx += (c0 * dx0 + c1 * dx1 + c2 * dx2 + c3 * dx3) * weight
        sy += along * (dy0, dy1, dy2, dy3)[j]
    edge = tl.minimum(tl.minimum(x - x_low, x_high - x), tl.minimum(y - y_low, y_high - y))
    return level + s, sx, sy, edge


@triton.jit
def b_spline_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives."""
    columns, near_x, near_y, place, coefficients, x_low, x_high, y_low, y_high = _stencil(
        record, codes, x, y
    )
    bx0, bx1, bx2, bx3, dx0, dx1, dx2, dx3 = _basis(near_x, x, x_low, x_high)
    by0, by1, by2, by3, dy0, dy1, dy2, dy3 = _basis(near_y, y, y_low, y_high)
    ex0, ex1, ex2, ex3 = _second_derivatives(near_x, x, x_low, x_high)
    ey0, ey1, ey2, ey3 = _second_derivatives(near_y, y, y_low, y_high)
    first = coefficients + place
    level = tl.load(first + columns + 1)
    sx, sy = tl.zeros_like(x), tl.zeros_like(x)
    sxx, sxy, syy = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for j in tl.static_range(4):
        weight, slope_weight = (by0, by1, by2, by3)[j], (dy0, dy1, dy2, dy3)[j]
        row = first + j * columns
        c0, c1 = tl.load(row) - level, tl.load(row + 1) - level
        c2, c3 = tl.load(row + 2) - level, tl.load(row + 3) - level
        along = c0 * bx0 + c1 * bx1 + c2 * bx2 + c3 * bx3
        slope = c0 * dx0 + c1 * dx1 + c2 * dx2 + c3 * dx3
        sx += slope * weight
        sy += along * slope_weight
        sxx += (c0 * ex0 + c1 * ex1 + c2 * ex2 + c3 * ex3) * weight
        sxy += slope * slope_weight
        syy += along * (ey0, ey1, ey2, ey3)[j]
    return sx, sy, sxx, sxy, syy


@triton.jit
def b_spline_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the coefficients, from those of the sag and its slopes.

    One stencil of 16 at a time, for all rays of the block that share it: the order of the additions
    is fixed.  Knots are no variables.
    """
    columns, near_x, near_y, place, _, x_low, x_high, y_low, y_high = _stencil(record, codes, x, y)
    bx0, bx1, bx2, bx3, dx0, dx1, dx2, dx3 = _basis(near_x, x, x_low, x_high)
    by0, by1, by2, by3, dy0, dy1, dy2, dy3 = _basis(near_y, y, y_low, y_high)
    into = sums + (tl.load(codes + COUNT) + columns + 2 * MORE_KNOTS + SHAPE)
    left = alive
    while tl.max(left.to(tl.int32), 0) > 0:
        stencil, here = first_of(place, left)
        for j in tl.static_range(4):
            weight = (by0, by1, by2, by3)[j]
            along = of_sag * weight + of_sy * (dy0, dy1, dy2, dy3)[j]
            across = of_sx * weight
            row = into + stencil + j * columns
            add_sum(row, along * bx0 + across * dx0, here)
            add_sum(row + 1, along * bx1 + across * dx1, here)
            add_sum(row + 2, along * bx2 + across * dx2, here)
            add_sum(row + 3, along * bx3 + across * dx3, here)
        left = left & (place != stencil)


KERNELS = SagFunctions(b_spline_sag, b_spline_hessian, b_spline_sums)
