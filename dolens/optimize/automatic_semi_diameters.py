"""Automatic semi-diameters give each surface the clear aperture that its light needs."""

import torch

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.rays import Components, Rays
from dolens.optics.surfaces.clear_aperture import Circle, Unlimited
from dolens.optimize.image_quality import without_edges

# Rays at the rim must lie strictly inside it.
_ROOM = 1.0 + 1e-6


@torch.no_grad()
def fitted_semi_diameters(lens: Lens, spots: SpotRays) -> dict[str, float]:
    """Return the largest distance from its vertex at which rays meet each surface.

    Args:
        lens: whose apertures do not matter.
        spots: rays out to the edges of the beams, as they were chosen for an earlier state of it.

    Returns:
        Number of each surface → mm: of rays of all fields; at the stop, of those nearest to the
        axis, so that the axial beam stays what it was.  Surfaces whose aperture is no circle
        without obscuration are left out.
    """
    opened = without_edges(lens)
    rays = Rays(spots.rays.position, spots.rays.direction, spots.rays.wavelength)
    hit = opened.trace(rays, record=True)
    axes = lens.system().axes
    square = spots.fields.square().sum(-1)
    nearest = (square == square.min()).to(spots.spot.device)[spots.spot]
    found = {}
    for place, (number, surface) in enumerate(lens.surfaces.items()):
        aperture = surface.aperture
        if not isinstance(aperture.edge, Circle | Unlimited) or aperture.obscuration is not None:
            continue
        x, y, z = hit.points[place].unbind(-1)
        local = from_lens_axes(Components(x, y, z, x, y, z), axes[place])
        heights = torch.hypot(local.x, local.y)
        if place + 1 == lens.stop:
            heights = heights[nearest]
        found[number] = float(heights.amax()) * _ROOM
    return found
