"""The share of a pupil's grid cells that light passes: apertures' edges without staircases."""

import torch
from torch import Tensor

from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Unlimited

# Smallest slope along one axis of a grid over that along the other: an edge along the grid.
_ALONG = 1e-3
_TINY = 1e-100


def coverage(aperture: ClearAperture, x: Tensor, y: Tensor, radius: Tensor | None = None) -> Tensor:
    """The share of every cell of a grid that an aperture passes.

    Args:
        aperture: of a surface.
        x: (..., S, S), mm, where the ray of the cell's centre crosses the surface, in its axes.
        y: (..., S, S), mm.
        radius: of the edge, a circle, mm, where a gradient with respect to it is wanted.

    Returns:
        (..., S, S), from 0 to 1; its derivative with respect to x, y and the radius is that
        of the area, as far as an edge is straight across a cell.
    """
    share = torch.ones_like(x)
    u, v = x - aperture.center[0], y - aperture.center[1]
    edge = aperture.edge
    if isinstance(edge, Circle) and radius is not None:
        # A circle's margin is r² - ρ².
        squared = radius.to(x).square()
        share = covered(edge.margin(x, y) + (squared - squared.detach()))
    elif not isinstance(edge, Unlimited):
        share = edge.share(covered, *((x, y) if edge.rotational else (u, v)))
    if aperture.window is not None:
        share = torch.minimum(share, aperture.window.share(covered, u, v))
    if aperture.obscuration is not None:
        # In cells of two edges, as where the arms of a spider end, these cross.
        share = share * (1.0 - aperture.obscuration.share(covered, u, v))
    return share


def covered(margin: Tensor) -> Tensor:
    """The share of every cell where a function given at the centres of a grid is positive.

    Within a cell the function is taken as linear, m + a·u + b·v with |u|, |v| ≤ 1/2, and m as its
    mean over the cell, so that the area inside a bent edge is right to higher order.  With
    R(t) = max(t, 0)²/2 the share is

        (R(m + (a + b)/2) - R(m + (a - b)/2) - R(m - (a - b)/2) + R(m - (a + b)/2)) / (a·b).

    Args:
        margin: (..., S, S).

    Returns:
        (..., S, S), from 0 to 1.
    """
    positive = margin.detach() > 0.0
    share = positive.to(margin.dtype)
    # All but a few cells lie on one side of the edge with all of their neighbours.
    edge = torch.nonzero(_beside_others(positive).flatten()).flatten()
    if len(edge) == 0:
        return share
    height, width = margin.shape[-2:]
    row, column = edge // width % height, edge % width
    m, flat = margin.flatten()[edge], margin.flatten()
    slopes = []
    mean = m
    for at, size, stride in ((column, width, 1), (row, height, width)):
        back, ahead = (at > 0).long(), (at < size - 1).long()
        before, behind = flat[edge - stride * back], flat[edge + stride * ahead]
        slopes.append(((behind - before) / (back + ahead)).abs())
        mean = mean + torch.where(back + ahead == 2, before + behind - 2.0 * m, 0.0) / 24.0
    a, b = slopes
    steepest = torch.maximum(a, b).detach().clamp(min=_TINY)
    a, b = torch.maximum(a, _ALONG * steepest), torch.maximum(b, _ALONG * steepest)
    wide, narrow = 0.5 * (a + b), 0.5 * (a - b)
    # Far from the edge the squares would cancel where they must not.
    mean = torch.minimum(torch.maximum(mean, -wide), wide)
    corners = _ramp(mean + wide) - _ramp(mean + narrow) - _ramp(mean - narrow) + _ramp(mean - wide)
    passed = (corners / (a * b)).clamp(0.0, 1.0)
    return share.flatten().index_copy(0, edge, passed).reshape(margin.shape)


def _ramp(t: Tensor) -> Tensor:
    return 0.5 * t.clamp(min=0.0).square()


def _beside_others(mask: Tensor) -> Tensor:
    """Return where a mask (..., S, S) may differ between a cell and any of its eight neighbours."""
    found = torch.zeros_like(mask)
    for dim in (-1, -2):
        # Beyond the grid nothing is known.
        found.select(dim, 0).fill_(True)
        found.select(dim, -1).fill_(True)
        size = mask.shape[dim] - 1
        differ = mask.narrow(dim, 0, size) != mask.narrow(dim, 1, size)
        found.narrow(dim, 0, size).logical_or_(differ)
        found.narrow(dim, 1, size).logical_or_(differ)
    grown = found.clone()
    for dim in (-1, -2):
        size = mask.shape[dim] - 1
        grown.narrow(dim, 0, size).logical_or_(found.narrow(dim, 1, size))
        grown.narrow(dim, 1, size).logical_or_(found.narrow(dim, 0, size))
    return grown
