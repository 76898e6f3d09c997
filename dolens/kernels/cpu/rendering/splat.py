"""Points are splatted onto pixels as quadratic B-splines; see `dolens.rendering.psf`.

Chunks of a grid's points have a grid each, which are then added in their order: the result depends
neither on the number of threads nor on their timing.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import UNBOUNDED

# Places in the splat's job, an array of integers: addresses of arrays;
ROWS, COLUMNS, WEIGHT, GRIDS, OF_ROWS, OF_COLUMNS, OF_WEIGHT = range(7)
# points of a grid, pixels along its side, points of a chunk, chunks of a grid.
POINTS, SIZE, CHUNK, CHUNKS = range(7, 11)
SPLAT_JOB = 64  # its length


@cache
def _taps(real: types.Type) -> tuple[Any, Any]:
    """Compile the central pixel of a point, with the offset, and the spline's values and slopes."""
    half, one = real(0.5), real(1.0)
    three_quarters, two = real(0.75), real(2.0)

    @njit(**OPTIONS)
    def centre(position, size):  # noqa: ANN001, ANN202
        """Return the nearest pixel and the offset from it; -2 where none of the three pixels is on
        the grid, or the position is no number.
        """
        if not (position > -two and position < real(size) + one):
            return types.int64(-2), half
        nearest = math.floor(position + half)
        return types.int64(nearest), position - real(nearest)

    @njit(**OPTIONS)
    def spline(d):  # noqa: ANN001, ANN202
        low, high = half - d, half + d
        return half * low * low, three_quarters - d * d, half * high * high, -low, -two * d, high

    return centre, spline


def splat_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that adds the points of chunks `first` to `last`, of all grids, to the
    chunks' grids.
    """
    at = real_at(real)
    centre, spline = _taps(real)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, SPLAT_JOB)
        rows, columns = carray(at(job[ROWS]), UNBOUNDED), carray(at(job[COLUMNS]), UNBOUNDED)
        weights, points, size = carray(at(job[WEIGHT]), UNBOUNDED), job[POINTS], job[SIZE]
        for chunk in range(first, last):
            grid = carray(shifted(at(job[GRIDS]), chunk * size * size), UNBOUNDED)
            start = (chunk // job[CHUNKS]) * points
            place = chunk % job[CHUNKS]
            for p in range(
                start + place * job[CHUNK], start + min((place + 1) * job[CHUNK], points)
            ):
                row, down = centre(rows[p], size)
                column, across = centre(columns[p], size)
                if row < -1 or column < -1:
                    continue
                a = spline(down)
                b = spline(across)
                for i in range(3):
                    for j in range(3):
                        r, c = row - 1 + i, column - 1 + j
                        if r >= 0 and r < size and c >= 0 and c < size:
                            grid[r * size + c] += weights[p] * (a[i] * b[j])

    return kernel


def splat_adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver of the cotangents of the points of chunks `first` to `last` from that of
    the grid.
    """
    at = real_at(real)
    centre, spline = _taps(real)
    zero = real(0.0)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, SPLAT_JOB)
        rows, columns = carray(at(job[ROWS]), UNBOUNDED), carray(at(job[COLUMNS]), UNBOUNDED)
        weights, points, size = carray(at(job[WEIGHT]), UNBOUNDED), job[POINTS], job[SIZE]
        of_rows = carray(at(job[OF_ROWS]), UNBOUNDED)
        of_columns = carray(at(job[OF_COLUMNS]), UNBOUNDED)
        of_weights = carray(at(job[OF_WEIGHT]), UNBOUNDED)
        for chunk in range(first, last):
            own = chunk // job[CHUNKS]
            grid = carray(shifted(at(job[GRIDS]), own * size * size), UNBOUNDED)
            start, place = own * points, chunk % job[CHUNKS]
            for p in range(
                start + place * job[CHUNK], start + min((place + 1) * job[CHUNK], points)
            ):
                row, down = centre(rows[p], size)
                column, across = centre(columns[p], size)
                of_row, of_column, of_weight = zero, zero, zero
                if row >= -1 and column >= -1:
                    a = spline(down)
                    b = spline(across)
                    for i in range(3):
                        for j in range(3):
                            r, c = row - 1 + i, column - 1 + j
                            if r >= 0 and r < size and c >= 0 and c < size:
                                cotangent = grid[r * size + c]
                                of_weight += cotangent * (a[i] * b[j])
                                of_row += cotangent * (a[3 + i] * b[j])
                                of_column += cotangent * (a[i] * b[3 + j])
                of_rows[p], of_columns[p] = weights[p] * of_row, weights[p] * of_column
                of_weights[p] = of_weight

    return kernel
