"""Numbers of pixels or rings of a plane element, on the cells of a regular grid.

Pixels stand in rows along y and columns along x, both rising, about the vertex; rings go from the
vertex outwards.  Beyond them numbers are zero.
"""

import torch
from torch import Tensor

_TINY = 1e-30


def on_pixels(values: Tensor, pitch: float, x: Tensor, y: Tensor) -> Tensor:
    """Return the numbers (Y, X) of the pixels that places lie in.

    Args:
        values: (rows, columns).
        pitch: mm.
        x: (X,), mm, of columns.
        y: (Y,), mm, of rows.
    """
    found = values
    for dim, (at, count) in enumerate(zip((y, x), values.shape, strict=True)):
        place = (at / pitch + 0.5 * count).floor()
        inside = (place >= 0.0) & (place < count)
        found = found.index_select(dim, place.clamp(0, count - 1).long())
        found = found * inside.to(found).unsqueeze(1 - dim)
    return found


def on_rings(
    values: Tensor, pitch: float, x: Tensor, y: Tensor, cell: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the numbers of rings on a grid (Y, X); and, where the edge of a ring cuts a cell, the
    share of the cell beyond the edge, and the number there.

    Args:
        values: (K,).
        pitch: mm, width of a ring.
        x: (X,), mm, of columns.
        y: (Y,), mm, of rows.
        cell: mm, of the grid.
    """
    count, r = len(values), torch.hypot(x[None], y[:, None])
    padded = torch.cat((values, values.new_zeros(1)))
    ring, border = (r / pitch).floor(), (r / pitch).round()
    other = torch.where(border > ring, ring + 1.0, ring - 1.0)
    inner, outer = (padded[k.clamp(0, count).long()] for k in (ring, other))
    width = (x[None].abs() + y[:, None].abs()) / r.clamp(min=_TINY) * cell
    distance = (r - pitch * border).abs() / width.clamp(min=_TINY)
    return inner, (0.5 - distance).clamp(min=0.0), outer
