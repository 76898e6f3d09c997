"""The real marginal ray: from the axis of the object to the rim of the paraxial entrance pupil."""

import math
from dataclasses import replace

import torch

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.surfaces.clear_aperture import Unlimited


@torch.no_grad()
def real_marginal_height(lens: Lens, z: float, radius: float, stop: float) -> float:
    """Return how far from the axis (mm) the real marginal ray crosses the stop, at the reference
    wavelength and whatever the apertures are.

    Args:
        lens: its reference wavelength and object distance count.
        z: of the entrance pupil, mm behind the first vertex.
        radius: of the entrance pupil, mm.
        stop: where the paraxial ray crosses it, mm.

    Raises:
        InputError: the pupil is at infinity, or the ray does not reach the stop.
    """
    if not math.isfinite(z):
        raise InputError("a real marginal ray needs an entrance pupil that is not at infinity")
    at = torch.tensor([0.0, radius, z], dtype=torch.float64)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if vergence(lens.object_distance) != 0.0:
        # The object may lie behind a virtual pupil; light travels towards +z all the same.
        direction = at - at.new_tensor([0.0, 0.0, -float(lens.object_distance)])
        direction = torch.copysign(1.0 / direction.norm(), direction[2]) * direction
    system = lens.system().opened().traced_by("reference")
    surfaces = list(system.surfaces)
    wide = replace(surfaces[lens.stop - 1].aperture, edge=Unlimited(stop))
    surfaces[lens.stop - 1] = replace(surfaces[lens.stop - 1], aperture=wide)
    system = replace(system, surfaces=surfaces)
    rays = Rays(at[None], direction[None], lens.primary_wavelength)
    hit = trace_rays(system, rays, 1.0, True, 1, lens.stop)
    if int(hit.status[0]) != Status.OK:
        raise InputError(
            "the real marginal ray, which gives the stop its size ('real_pupil'), does not reach it"
        )
    x, y, z_there = hit.points[-1][0]
    local = from_lens_axes(Components(x, y, z_there, *direction.to(x)), system.axes[lens.stop - 1])
    return float(torch.hypot(local.x, local.y))
