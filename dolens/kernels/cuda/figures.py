"""Polygons, rings and arms of spiders stop rays; see `dolens.kernels.table.Figure`."""

import triton
import triton.language as tl

from dolens.kernels.cuda.layout import ARM, ELLIPTIC


@triton.jit
def in_polygon(sides, count, x, y, on_it):
    """Return whether points are inside a polygon; on a side the answer is `on_it`."""
    odd = tl.full(x.shape, 0, tl.int32)
    on = tl.full(x.shape, 0, tl.int32)
    for k in range(count // 4):
        ax, ay = tl.load(sides + 4 * k), tl.load(sides + 4 * k + 1)
        bx, by = tl.load(sides + 4 * k + 2), tl.load(sides + 4 * k + 3)
        u, v = x - ax, y - ay
        cross = (bx - ax) * v - (by - ay) * u
        here = (cross == 0.0) & (u * (x - bx) <= 0.0) & (v * (y - by) <= 0.0)
        on = on | here.to(tl.int32)
        # The lower end of a side counts and the upper one does not.
        upwards = (y >= ay) & (y < by) & (cross > 0.0)
        downwards = (y >= by) & (y < ay) & (cross < 0.0)
        odd = odd ^ (upwards | downwards).to(tl.int32)
    return tl.where(on > 0, on_it, odd > 0)


@triton.jit
def clear_of_figures(figures, x, y):
    """Return whether no figure stops the rays at x, y; `figures` points to their numbers."""
    clear = tl.full(x.shape, 1, tl.int32)
    at = figures + 1
    for _ in range(tl.load(figures).to(tl.int32)):
        kind, count = tl.load(at).to(tl.int32), tl.load(at + 4).to(tl.int32)
        blocks = tl.load(at + 1) > 0.5
        u, v = x - tl.load(at + 2), y - tl.load(at + 3)
        own = at + 5
        inside = tl.full(x.shape, 0, tl.int32)
        if kind == ELLIPTIC:
            square = tl.load(own) * u * u + tl.load(own + 1) * v * v
            within = (square >= tl.load(own + 2)) & (square <= tl.load(own + 3))
            inside = within.to(tl.int32)
        elif kind == ARM:
            c, s = tl.load(own), tl.load(own + 1)
            within = (c * u + s * v >= 0.0) & (tl.abs(c * v - s * u) <= tl.load(own + 2))
            inside = within.to(tl.int32)
        else:
            inside = in_polygon(own, count, u, v, blocks).to(tl.int32)
        clear = clear & (inside != blocks.to(tl.int32)).to(tl.int32)
        at = at + 5 + count
    return clear > 0
