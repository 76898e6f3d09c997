"""Automatic semi-diameters give each surface the clear aperture that its light needs."""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.rays import Components, Rays
from dolens.optics.surfaces.clear_aperture import Circle, Unlimited
from dolens.optimize.image_quality import without_edges

# Rays at the rim must lie strictly inside it.
_ROOM = 1.0 + 1e-6
# Points of the stop's rim.
_RIM = 16


class RimRays(NamedTuple):
    """A `RimRays` holds rays through the rim of the stop; see `SpotRays`.

    Attributes:
        rays: N rays.
        fields: (S, 2), of every spot.
        spot: (N,), the spot of each ray.
    """

    rays: Rays
    fields: Tensor
    spot: Tensor


@torch.no_grad()
def rim_rays(lens: Lens, where: Conditions) -> RimRays:
    """Return the rays of fields and wavelengths that are aimed at the rim of the stop, where they
    can be.

    Where nothing in front of the stop clips, a strongly aberrated ray may pass the stop far from
    its beam; it is none of these.

    Args:
        lens: with a circular stop.
        where: fields, wavelengths and object distance.
    """
    angle = torch.arange(_RIM, dtype=torch.float64) * (2.0 * torch.pi / _RIM)
    rim = torch.stack((angle.cos(), angle.sin()), -1).to(lens.sensor_distance)
    places, waves = where.fields, where.wavelengths.to(lens.device)
    grid = places.to(lens.sensor_distance)[:, None, None].expand(-1, len(waves), _RIM, 2)
    wave = waves[None, :, None].expand(grid.shape[:-1])
    aimed = lens.aim(grid, rim.expand_as(grid), wave, where.object_distance)
    spot = torch.arange(len(places) * len(waves), device=lens.device)
    spot = spot.reshape(len(places), len(waves), 1).expand(grid.shape[:-1])
    found = aimed.converged
    rays = Rays(aimed.position[found], aimed.direction[found], wave[found])
    return RimRays(rays, places.repeat_interleave(len(waves), 0), spot[found])


@torch.no_grad()
def fitted_semi_diameters(
    lens: Lens, spots: SpotRays | RimRays, room: float = _ROOM
) -> dict[str, float]:
    """Return the largest distance from its vertex at which rays meet each surface.

    Args:
        lens: whose apertures do not matter.
        spots: rays out to the edges of the beams, as they were chosen for an earlier state of it.
        room: factor of every height, above 1.

    Returns:
        Number of each surface → mm: of rays of all fields; at the stop, of those nearest to the
        axis, so that the axial beam stays what it was.  Surfaces whose aperture is no circle
        without obscuration are left out.
    """
    opened = without_edges(lens)
    rays = Rays(spots.rays.position, spots.rays.direction, spots.rays.wavelength)
    points = opened.trace(rays, record=True).points
    assert points is not None  # they were recorded
    axes = lens.system().axes
    square = spots.fields.square().sum(-1)
    nearest = (square == square.min()).to(spots.spot.device)[spots.spot]
    found = {}
    for place, (number, surface) in enumerate(lens.surfaces.items()):
        aperture = surface.aperture
        if not isinstance(aperture.edge, Circle | Unlimited) or aperture.obscuration is not None:
            continue
        x, y, z = points[place].unbind(-1)
        local = from_lens_axes(Components(x, y, z, x, y, z), axes[place])
        heights = torch.hypot(local.x, local.y)
        if place + 1 == lens.stop:
            heights = heights[nearest]
        found[number] = float(heights.amax()) * room
    return found
