"""Clear apertures made of polygons, rings and arms of spiders stop rays."""

import math
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.layout import UNBOUNDED
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
