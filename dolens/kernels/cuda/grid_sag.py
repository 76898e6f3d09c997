"""A bicubic grid on an even asphere; see `dolens.optics.surfaces.grid_sag`.

The record holds the even asphere's numbers, and then data: spacing of columns and rows, decentre,
and four numbers (value, slopes, twist) of each node, by rows.
"""

import triton
import triton.language as tl

from dolens.kernels import cubics
from dolens.kernels.cuda.arithmetic import divide
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COLUMNS, COUNT, DEGREE, SHAPE
from dolens.kernels.cuda.shapes import (
    even_asphere_hessian,
    even_asphere_sag,
    even_asphere_sums,
)
from dolens.kernels.cuda.translation import compiled

OWN = tl.constexpr(int(SHAPE) + 3)  # where there are no even coefficients but a2
NODES = tl.constexpr(4)
basis, second_derivatives = compiled(cubics.hermite), compiled(cubics.hermite_second)


@triton.jit
def _place(u, spacing, count):
    """Return the lower node of each point's cell, and the place within the cell, in cells."""
    # An integer times a literal would be in single precision.
    middle = 0.5 * ((count - 1) + tl.zeros_like(u))
    place = divide(u, spacing + tl.zeros_like(u)) + middle
    place = tl.where(tl.abs(place) < 1e9, place, 0.0)
    first = tl.floor(place).to(tl.int32)
    first = tl.where(first < 0, 0, first)
    first = tl.where(first > count - 2, count - 2, first)
    return first, place - first.to(u.dtype)


@triton.jit
def _grid(record, codes, x, y):
    """Return what `_place` and the record say of each point's cell."""
    own = record + OWN + tl.load(codes + COUNT)
    columns, rows = tl.load(codes + COLUMNS), tl.load(codes + DEGREE)
    width, height = tl.load(own), tl.load(own + 1)
    u, v = x - tl.load(own + 2), y - tl.load(own + 3)
    column, across = _place(u, width, columns)
    row, along = _place(v, height, rows)
    edge_x, edge_y = width * (columns - 1) * 0.5, height * (rows - 1) * 0.5
    edge = tl.minimum(edge_x - tl.abs(u), edge_y - tl.abs(v))
    node = own + NODES + 4 * (row * columns + column)
    return node, 4 * columns, across, along, width, height, edge


@triton.jit
def grid_sag(record, codes, extras, x, y):
    """Return sag, slopes, and a margin that is positive on the conic and on the grid."""
    sag, sx, sy, margin = even_asphere_sag(record, codes, extras, x, y)
    node, step, across, along, width, height, edge = _grid(record, codes, x, y)
    bx, by = basis(across, width), basis(along, height)
    for j in tl.static_range(2):
        for k in tl.static_range(2):
            at = node + j * step + 4 * k
            value, slope_x = tl.load(at), tl.load(at + 1)
            slope_y, twist = tl.load(at + 2), tl.load(at + 3)
            low = value * bx[2 * k] + slope_x * bx[2 * k + 1]
            high = slope_y * bx[2 * k] + twist * bx[2 * k + 1]
            low_x = value * bx[4 + 2 * k] + slope_x * bx[5 + 2 * k]
            high_x = slope_y * bx[4 + 2 * k] + twist * bx[5 + 2 * k]
            sag += low * by[2 * j] + high * by[2 * j + 1]
            sx += low_x * by[2 * j] + high_x * by[2 * j + 1]
            sy += low * by[4 + 2 * j] + high * by[5 + 2 * j]
    return sag, sx, sy, tl.minimum(margin, edge)


@triton.jit
def grid_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives."""
    sx, sy, sxx, sxy, syy = even_asphere_hessian(record, codes, extras, x, y)
    node, step, across, along, width, height, _ = _grid(record, codes, x, y)
    bx, by = basis(across, width), basis(along, height)
    ex, ey = second_derivatives(across, width), second_derivatives(along, height)
    for j in tl.static_range(2):
        for k in tl.static_range(2):
            at = node + j * step + 4 * k
            value, slope_x = tl.load(at), tl.load(at + 1)
            slope_y, twist = tl.load(at + 2), tl.load(at + 3)
            low = value * bx[2 * k] + slope_x * bx[2 * k + 1]
            high = slope_y * bx[2 * k] + twist * bx[2 * k + 1]
            low_x = value * bx[4 + 2 * k] + slope_x * bx[5 + 2 * k]
            high_x = slope_y * bx[4 + 2 * k] + twist * bx[5 + 2 * k]
            low_xx = value * ex[2 * k] + slope_x * ex[2 * k + 1]
            high_xx = slope_y * ex[2 * k] + twist * ex[2 * k + 1]
            sx += low_x * by[2 * j] + high_x * by[2 * j + 1]
            sy += low * by[4 + 2 * j] + high * by[5 + 2 * j]
            sxx += low_xx * by[2 * j] + high_xx * by[2 * j + 1]
            sxy += low_x * by[4 + 2 * j] + high_x * by[5 + 2 * j]
            syy += low * ey[2 * j] + high * ey[2 * j + 1]
    return sx, sy, sxx, sxy, syy


@triton.jit
def grid_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the even asphere's numbers: the grid is data."""
    even_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive)


KERNELS = SagFunctions(grid_sag, grid_hessian, grid_sums, starts_on_conic=True)
