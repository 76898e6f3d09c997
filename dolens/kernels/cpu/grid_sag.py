"""A bicubic grid on an even asphere; see `dolens.optics.surfaces.grid_sag`.

The record holds the even asphere's numbers, and then data: spacing of columns and rows, decentre,
and four numbers (value, slopes, twist) of each node, by rows.  Each ray's 16 numbers are brought to
work rows, and the arithmetic then runs over rows.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, call_block, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.layout import (
    ASPHERE_HESSIAN,
    ASPHERE_PARAMETERS,
    ASPHERE_SAG,
    BEHIND_ASPHERE,
    BLOCK,
    CODE_ROW,
    COLUMNS,
    COUNT,
    DEGREE,
    FURTHER,
    MARGIN,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.cubics import hermite, hermite_second

# Behind the even asphere's numbers: spacings, decentre, nodes.
NODES = 4
# Work rows: places within the cell (in cells), and the cell's 16 numbers by columns of four: both
# nodes of the lower row, then of the upper one.
ROWS = 18
PLACE_X, PLACE_Y, CELL = (FURTHER + BLOCK * row for row in range(3))


@cache
def _cells(real: types.Type) -> tuple[Any, Any, Any]:
    """Return the search for cells, Hermite's basis, and its second derivatives."""
    zero, half = real(0.0), real(0.5)

    @njit(**OPTIONS)
    def place_of(u, spacing, count):  # noqa: ANN001, ANN202
        """Return a place in cells from the first node; what is no number lies on it."""
        place = u / spacing + half * real(count - 1)
        return place if math.fabs(place) < real(1e9) else zero

    @njit(**OPTIONS)
    def fetch(w, own, columns, rows):  # noqa: ANN001, ANN202
        """Fill the work rows for all rays of a block."""
        for i in range(BLOCK):
            across = place_of(w[POINT_X + i] - own[2], own[0], columns)
            along = place_of(w[POINT_Y + i] - own[3], own[1], rows)
            column = min(max(types.int64(math.floor(across)), 0), columns - 2)
            row = min(max(types.int64(math.floor(along)), 0), rows - 2)
            w[PLACE_X + i], w[PLACE_Y + i] = across - real(column), along - real(row)
            lower = NODES + 4 * (row * columns + column)
            upper = lower + 4 * columns
            for k in range(8):
                w[CELL + BLOCK * k + i] = own[lower + k]
                w[CELL + BLOCK * (8 + k) + i] = own[upper + k]

    basis, second_derivatives = (
        scalar(function, real, "always") for function in (hermite, hermite_second)
    )
    return fetch, basis, second_derivatives


def grid_sag(real: types.Type) -> Callable[..., None]:
    """Add the grid to the rows of sag and slopes; the margin is positive on the grid too."""
    fetch, basis, _ = _cells(real)
    zero, half = real(0.0), real(0.5)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(q[ASPHERE_SAG], before, after, cotangents, record, work, codes)
        own = carray(shifted(record, BEHIND_ASPHERE + q[COUNT]), UNBOUNDED)
        fetch(w, own, q[COLUMNS], q[DEGREE])
        half_x = half * real(q[COLUMNS] - 1) * own[0]
        half_y = half * real(q[DEGREE] - 1) * own[1]
        for i in range(BLOCK):
            bx = basis(w[PLACE_X + i], own[0])
            by = basis(w[PLACE_Y + i], own[1])
            s = sx = sy = zero
            for j in range(2):
                for k in range(2):
                    cell = CELL + BLOCK * (8 * j + 4 * k) + i
                    value, along = w[cell], w[cell + BLOCK]
                    across, twist = w[cell + 2 * BLOCK], w[cell + 3 * BLOCK]
                    low = value * bx[2 * k] + along * bx[2 * k + 1]
                    high = across * bx[2 * k] + twist * bx[2 * k + 1]
                    low_x = value * bx[4 + 2 * k] + along * bx[5 + 2 * k]
                    high_x = across * bx[4 + 2 * k] + twist * bx[5 + 2 * k]
                    s += low * by[2 * j] + high * by[2 * j + 1]
                    sx += low_x * by[2 * j] + high_x * by[2 * j + 1]
                    sy += low * by[4 + 2 * j] + high * by[5 + 2 * j]
            w[SAG + i] += s
            w[SLOPE_X + i] += sx
            w[SLOPE_Y + i] += sy
            edge_x = half_x - math.fabs(w[POINT_X + i] - own[2])
            edge_y = half_y - math.fabs(w[POINT_Y + i] - own[3])
            margin = w[MARGIN + i]
            margin = edge_x if edge_x < margin else margin
            w[MARGIN + i] = edge_y if edge_y < margin else margin

    return kernel


def grid_hessian(real: types.Type) -> Callable[..., None]:
    """Add the grid to the rows of slopes and second derivatives."""
    fetch, basis, second_derivatives = _cells(real)
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, UNBOUNDED), carray(codes, CODE_ROW)
        call_block(q[ASPHERE_HESSIAN], before, after, cotangents, record, work, codes)
        own = carray(shifted(record, BEHIND_ASPHERE + q[COUNT]), UNBOUNDED)
        fetch(w, own, q[COLUMNS], q[DEGREE])
        for i in range(BLOCK):
            bx = basis(w[PLACE_X + i], own[0])
            by = basis(w[PLACE_Y + i], own[1])
            ex = second_derivatives(w[PLACE_X + i], own[0])
            ey = second_derivatives(w[PLACE_Y + i], own[1])
            sx = sy = sxx = sxy = syy = zero
            for j in range(2):
                for k in range(2):
                    cell = CELL + BLOCK * (8 * j + 4 * k) + i
                    value, along = w[cell], w[cell + BLOCK]
                    across, twist = w[cell + 2 * BLOCK], w[cell + 3 * BLOCK]
                    low = value * bx[2 * k] + along * bx[2 * k + 1]
                    high = across * bx[2 * k] + twist * bx[2 * k + 1]
                    low_x = value * bx[4 + 2 * k] + along * bx[5 + 2 * k]
                    high_x = across * bx[4 + 2 * k] + twist * bx[5 + 2 * k]
                    low_xx = value * ex[2 * k] + along * ex[2 * k + 1]
                    high_xx = across * ex[2 * k] + twist * ex[2 * k + 1]
                    sx += low_x * by[2 * j] + high_x * by[2 * j + 1]
                    sy += low * by[4 + 2 * j] + high * by[5 + 2 * j]
                    sxx += low_xx * by[2 * j] + high_xx * by[2 * j + 1]
                    sxy += low_x * by[4 + 2 * j] + high_x * by[5 + 2 * j]
                    syy += low * ey[2 * j] + high * ey[2 * j + 1]
            w[SLOPE_X + i] += sx
            w[SLOPE_Y + i] += sy
            w[SAG_XX + i] += sxx
            w[SAG_XY + i] += sxy
            w[SAG_YY + i] += syy

    return kernel


def grid_parameters(real: types.Type) -> Callable[..., None]:
    """Fill the cotangents of the even asphere's numbers: the grid is data."""

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        q = carray(codes, CODE_ROW)
        call_block(q[ASPHERE_PARAMETERS], before, after, cotangents, record, work, codes)

    return kernel


def _rows(row: Sequence[int]) -> int:
    """Return the number of work rows of its own."""
    return ROWS


KERNELS = given_by_sag(
    grid_sag, grid_hessian, grid_parameters, starts_on_conic=True, scratch=_rows, on_asphere=True
)
