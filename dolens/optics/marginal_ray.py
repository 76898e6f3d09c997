"""The real marginal ray: it leaves the axis of the object as the paraxial one does."""

import math
from dataclasses import replace

import torch

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.paraxial import matrix_to_stop, vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.surfaces.clear_aperture import Unlimited


@torch.no_grad()
def real_marginal_height(lens: Lens, paraxial: float) -> float:
    """Return how far from the axis (mm) the real marginal ray crosses the stop, at the reference
    wavelength and whatever the apertures are.

    Args:
        lens: its reference wavelength and object distance count.
        paraxial: where the paraxial marginal ray crosses the stop, mm.

    Raises:
        InputError: the ray does not reach the stop.
    """
    system = lens.system().opened().traced_by("reference")
    stop = system.surfaces[lens.stop - 1]
    surfaces = list(system.surfaces)
    surfaces[lens.stop - 1] = replace(
        stop, aperture=replace(stop.aperture, edge=Unlimited(paraxial))
    )
    system = replace(system, surfaces=surfaces)
    wavelength = lens.primary_wavelength
    # The height at the stop is a·y + b·n·u of a ray that meets the first vertex at y with slope u.
    (a, b), _ = matrix_to_stop(system.section("y"), wavelength).tolist()
    if lens.object_distance is None or vergence(lens.object_distance) == 0.0:
        start, slope = [0.0, paraxial / abs(a), 0.0], 0.0
    else:
        distance = float(lens.object_distance)
        index = float(lens.materials[0].index(wavelength))
        start, slope = [0.0, 0.0, -distance], paraxial / abs(a * distance + b * index)
    length = math.hypot(1.0, slope)
    position = torch.tensor([start], dtype=torch.float64)
    direction = torch.tensor([[0.0, slope / length, 1.0 / length]], dtype=torch.float64)
    hit = trace_rays(system, Rays(position, direction, wavelength), 1.0, True, 1, lens.stop)
    if int(hit.status[0]) != Status.OK:
        raise InputError(
            "the real marginal ray, which gives the stop its size ('real_pupil'), does not reach it"
        )
    assert hit.points is not None  # they were recorded
    at = hit.points[-1][0]
    local = from_lens_axes(Components(*at, *direction[0].to(at)), system.axes[lens.stop - 1])
    return float(torch.hypot(local.x, local.y))
