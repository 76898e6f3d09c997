"""The derivative of a pupil's bounds, and of the grid that samples it, with respect to the lens.

A regular grid reaches from one end of the light to the other.  Sums over it err by the cells that
edges cut, and the error depends on where edges lie between the cells.  A grid that follows the
light keeps them there, in the value; its derivative must follow it too, or it has an error of the
order of the square root of a cell's share of the pupil.
"""

from dataclasses import replace

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import PupilFit, at_points, chebyshev

# Cells along each side in the search for the ends of the light, and Newton's steps to the edge.
_SIDE, _ITERATIONS = 48, 3
# Differences for the edge's slope, and how far from a bound its end may lie, in cosines over the
# width of the light.
_STEP, _NEAR = 1e-4, 0.1
_TINY = 1e-30


def with_differentiable_bounds(fit: PupilFit) -> PupilFit:
    """A fit whose bounds have the gradients of the edges that end the light.

    With d(α; θ) the distance inside an edge, and α the cosine along one axis of the light's last
    point, d = 0 gives ∂α/∂θ = -(∂d/∂θ)/(∂d/∂α): along the edge α does not change there.  An end
    that no aperture makes is held.  Bounds lie a little outside of the light, by a share of its
    width that is kept.
    """
    edges = [surface.edge for surface in fit.wavefront.clipping.values()]
    moving = fit.coefficients.requires_grad or any(e is not None and e.requires_grad for e in edges)
    if not edges or not moving or not torch.is_grad_enabled():
        return fit
    place, which, slope = _ends(fit)
    depth = _depths(fit, place).gather(1, which[:, None])[:, 0]
    inverse = torch.where(slope.abs() > _TINY, 1.0 / slope, 0.0)
    first, last = ((depth.detach() - depth) * inverse).unflatten(1, (2, 2)).unbind(1)
    start, end = torch.stack((place[:, :2], place[:, 2:])).diagonal(dim1=2, dim2=3)
    width = torch.where(end > start, end - start, 1.0)
    low = fit.low + first - (start - fit.low) / width * (last - first)
    high = fit.high + last + (fit.high - end) / width * (last - first)
    return replace(fit, low=low, high=high)


@torch.no_grad()
def _ends(fit: PupilFit) -> tuple[Tensor, Tensor, Tensor]:
    """The light's last points towards -x, -y, +x and +y of N pupils.

    Returns:
        The points (N, 4, 2), which of the clipping surfaces ends the light there (N, 4), and the
        slope of the distance from its edge along the axis (N, 4); 0 where no edge was found.
    """
    step = (torch.arange(_SIDE, dtype=fit.low.dtype, device=fit.low.device) + 0.5) / _SIDE
    share = torch.stack(torch.meshgrid(step, step, indexing="ij"), -1).reshape(-1, 2)
    width = fit.high - fit.low
    grid = fit.low[:, None] + width[:, None] * share
    depth = _depths(fit, grid).amin(1)
    starts = []
    for axis, sign in ((0, -1.0), (1, -1.0), (0, 1.0), (1, 1.0)):
        # The farthest row with light, and in it the point deepest in the light.
        rank = torch.where(depth > 0.0, sign * share[:, axis], -torch.inf)
        last = rank >= rank.amax(1, keepdim=True) - 0.5 / _SIDE
        starts.append(torch.where(last, depth, -torch.inf).argmax(1))
    place = grid.gather(1, torch.stack(starts, 1)[..., None].expand(-1, -1, 2))
    axes = torch.tensor([0, 1, 0, 1], device=place.device)
    along = torch.nn.functional.one_hot(axes, 2).to(place)
    reach = (width[:, axes] * _STEP)[..., None] * along
    for _ in range(_ITERATIONS):
        distance, slope, which = _along(fit, place, reach)
        shift = torch.where(slope.abs() > _TINY, -distance / slope, 0.0)
        limit = width[:, axes] / _SIDE
        place = place + torch.clamp(shift, -limit, limit)[..., None] * along
    _, slope, which = _along(fit, place, reach)
    bounds = torch.cat((fit.low, fit.high), 1)
    at = place.gather(2, axes[:, None].expand(len(place), -1, 1))[..., 0]
    near = (at - bounds).abs() <= _NEAR * width[:, axes]
    outwards = torch.tensor([1.0, 1.0, -1.0, -1.0], device=place.device) * slope > 0.0
    lit = (depth > 0.0).any(1, keepdim=True)
    return place, which, torch.where(near & outwards & lit, slope, 0.0)


def _along(fit: PupilFit, place: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distance (N, 4) inside the nearest edge, its slope by cosine, and whose edge it is."""
    depth, which = _depths(fit, place).min(1)
    ahead, behind = (
        _depths(fit, place + sign * reach).gather(1, which[:, None])[:, 0] for sign in (1.0, -1.0)
    )
    return depth, (ahead - behind) / (2.0 * reach.sum(-1)), which


def _depths(fit: PupilFit, cosines: Tensor) -> Tensor:
    """Return distances inside the clipping edges (N, surfaces, M), mm, at cosines (N, M, 2)."""
    unit = (cosines - fit.centre[:, None]) / fit.half_width[:, None]
    degree = fit.coefficients.shape[-1] - 1
    x, y = (chebyshev(unit[..., axis].clamp(-1.0, 1.0), degree)[0] for axis in (0, 1))
    crossings = at_points(fit.coefficients[:, 2:], x, y)
    surfaces = fit.wavefront.clipping.values()
    pairs = zip(surfaces, crossings.split(2, 1), strict=True)
    return torch.stack([s.edge_distance(c[:, 0], c[:, 1]) for s, c in pairs], 1)
