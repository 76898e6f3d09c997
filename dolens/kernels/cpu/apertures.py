"""Clear apertures stop rays: rectangles, ellipses, and figures of polygons, rings and arms."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.layout import (
    BLOCK,
    CENTER_X,
    CENTER_Y,
    CIRCLE,
    CODE_ROW,
    ELLIPSE,
    FIGURES,
    HALF_X,
    HALF_Y,
    HOLE,
    HOLE_X,
    HOLE_Y,
    OUTLINE,
    RECTANGLE,
    SHORT_RECORD,
    STATE,
    STOPPED,
    TAG,
    UNBOUNDED,
    VIGNETTED,
    X,
    Y,
)
from dolens.kernels.table import Figure

_ELLIPTIC, _ARM = int(Figure.ELLIPTIC), int(Figure.ARM)


@cache
def stopped_by_figures(real: types.Type) -> Any:
    """Compile the test whether the figures of a record stop a ray at x, y, for a real type."""
    zero, blocking = real(0.0), real(0.5)

    @njit(**OPTIONS)
    def in_polygon(p, count, x, y, on_it):  # noqa: ANN001, ANN202
        """Return whether a point is inside a polygon; on a side the answer is `on_it`."""
        odd = False
        for side in range(count // 4):
            ax, ay, bx, by = p[4 * side], p[4 * side + 1], p[4 * side + 2], p[4 * side + 3]
            u, v = x - ax, y - ay
            cross = (bx - ax) * v - (by - ay) * u
            if cross == zero and u * (x - bx) <= zero and v * (y - by) <= zero:
                return on_it
            # The lower end of a side counts and the upper one does not.
            if by > ay:
                odd = odd != (y >= ay and y < by and cross > zero)
            else:
                odd = odd != (y >= by and y < ay and cross < zero)
        return odd

    @njit(**OPTIONS)
    def stopped(figures, x, y):  # noqa: ANN001, ANN202
        """Return whether any figure stops a ray at x, y; `figures` points to their numbers."""
        p = carray(figures, UNBOUNDED)
        at = 1
        for _ in range(types.int64(p[0])):
            kind, count = types.int64(p[at]), types.int64(p[at + 4])
            blocks = p[at + 1] > blocking
            u, v = x - p[at + 2], y - p[at + 3]
            own = carray(shifted(figures, at + 5), UNBOUNDED)
            if kind == _ELLIPTIC:
                square = own[0] * u * u + own[1] * v * v
                inside = square >= own[2] and square <= own[3]
            elif kind == _ARM:
                inside = own[0] * u + own[1] * v >= zero
                inside = inside and math.fabs(own[0] * v - own[1] * u) <= own[2]
            else:
                inside = in_polygon(own, count, u, v, blocks)
            if inside == blocks:
                return True
            at += 5 + count
        return False

    return stopped


def clip(real: types.Type) -> Callable[..., None]:
    """Vignette where the clear aperture is no full circle; the circle is tested on the way."""
    zero, one, vignetted = real(0.0), real(1.0), real(STOPPED)
    stopped = stopped_by_figures(real)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        dst, p, q = carray(after, STATE), carray(record, SHORT_RECORD), carray(codes, CODE_ROW)
        half_x, half_y, hole_x, hole_y, tag = p[HALF_X], p[HALF_Y], p[HOLE_X], p[HOLE_Y], p[TAG]
        center_x, center_y, outline, hole = p[CENTER_X], p[CENTER_Y], q[OUTLINE], q[HOLE]
        figures = q[FIGURES]
        for i in range(BLOCK):
            x, y = math.fabs(dst[X + i] - center_x), math.fabs(dst[Y + i] - center_y)
            passes = True
            if figures != 0:
                passes = not stopped(shifted(record, figures), dst[X + i], dst[Y + i])
            if outline == RECTANGLE:
                passes = passes and x < half_x and y < half_y
            elif outline == ELLIPSE:
                passes = passes and half_x * x * x + half_y * y * y < one
            if hole == CIRCLE:
                passes = passes and x * x + y * y > hole_x
            elif hole == RECTANGLE:
                passes = passes and (x > hole_x or y > hole_y)
            elif hole == ELLIPSE:
                passes = passes and hole_x * x * x + hole_y * y * y > one
            if not passes and not dst[VIGNETTED + i] > zero:
                dst[VIGNETTED + i] = tag + vignetted

    return kernel
