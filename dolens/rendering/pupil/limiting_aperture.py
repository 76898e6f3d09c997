"""The aperture's edge that limits the axial beam, and distances of rays from such edges."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.elements import from_lens_axes
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import trace_surfaces
from dolens.rendering.pupil.rays_to_exit_pupil import rays_to_exit_pupil

_AZIMUTHS = 16
# An axial ray that passes every edge at this share of its semi-diameter is limited by none.
_LIMITED = 1e-2
_ITERATIONS = 4


class LimitingAperture(NamedTuple):
    """The limit of the axial beam: a surface's number, the ray's azimuth, and its wavelength."""

    surface: int
    azimuth: float
    wavelength: float


@torch.no_grad()
def limiting_aperture(
    system: OpticalSystem, wavelengths: Sequence[float], z: float, radius: float
) -> LimitingAperture | None:
    """The edge that the rim of a disc of the exit pupil is nearest to; None where none is near.

    Args:
        system: the lens.
        wavelengths: nm.
        z: of the disc, mm from the first vertex.
        radius: of the disc, mm, that axial rays fill.
    """
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    count = 1 if system.rotationally_symmetric else _AZIMUTHS
    angle = torch.arange(count, **options) * (2.0 * math.pi / _AZIMUTHS)
    origin, sensor_z = torch.zeros((), **options), system.vertices[-1]
    across, up = radius * torch.cos(angle), radius * torch.sin(angle)
    every = torch.tensor(wavelengths, **options)[:, None]
    one = torch.ones_like(every)
    ray = rays_to_exit_pupil(origin, origin, sensor_z, across * one, up * one, z)
    trace = trace_surfaces(system, ray, every, sense=-1.0, record=True)
    nearest, limit = _LIMITED, None
    for margins, point in zip(trace.margins, trace.points, strict=True):
        depth = _edge_distance(system, margins.number, point)
        share, place = (depth / system.surfaces[margins.number - 1].semi_diameter).flatten().min(0)
        if float(share) < nearest:
            nearest = float(share)
            colour, azimuth = divmod(int(place), count)
            limit = LimitingAperture(margins.number, float(angle[azimuth]), wavelengths[colour])
    return limit


def limiting_edge_distance(
    system: OpticalSystem,
    limit: LimitingAperture,
    radius: Tensor,
    z: float | Tensor,
) -> Tensor:
    """Return the distance inside the limiting edge of the axial ray to a radius of the disc, mm.

    Differentiable in the radius (), in z and in the lens.
    """
    zero = torch.zeros_like(radius)[None]
    across, up = math.cos(limit.azimuth) * radius[None], math.sin(limit.azimuth) * radius[None]
    ray = rays_to_exit_pupil(zero, zero, system.vertices[-1], across, up, z)
    return edge_distances(system, ray, limit.surface, limit.wavelength)[0]


@torch.no_grad()
def limiting_pupil_radius(
    system: OpticalSystem,
    limit: LimitingAperture,
    z: float,
    low: float,
    high: float,
) -> float:
    """The radius between two whose axial ray grazes the limiting edge: regula falsi.

    The lower one itself where the edge is not between the two.
    """

    def distance(radius: float) -> float:
        reach = torch.tensor(radius, dtype=system.dtype, device=system.device)
        return float(limiting_edge_distance(system, limit, reach, z))

    start, inside, outside = low, distance(low), distance(high)
    if not inside >= 0.0 > outside:
        return start
    for _ in range(_ITERATIONS):
        middle = low + (high - low) * inside / (inside - outside)
        found = distance(middle)
        if found >= 0.0:
            low, inside = middle, found
        else:
            high, outside = middle, found
    return low + (high - low) * inside / (inside - outside)


def edge_distances(
    system: OpticalSystem,
    ray: Components,
    surface: int,
    wavelength: float | Tensor,
) -> Tensor:
    """Return the distance inside a surface's edge of rays from the sensor, mm; negative outside.

    Differentiable in the rays and the lens, for rays that other edges would stop as well.

    Args:
        system: the lens.
        ray: from the sensor, travelling towards -z.
        surface: the number of the surface.
        wavelength: nm, a number or a tensor that broadcasts with the rays.
    """
    rays = Rays.from_components(ray, wavelength)
    hit = trace_rays(system.opened(), rays, -1.0, first=surface)
    return _edge_distance(system, surface, hit.position.unbind(-1))


def _edge_distance(system: OpticalSystem, surface: int, point: Sequence[Tensor]) -> Tensor:
    x, y, z = point
    zero = torch.zeros_like(x)
    here = from_lens_axes(Components(x, y, z, zero, zero, zero), system.axes[surface - 1])
    return system.surfaces[surface - 1].edge_distance(here.x, here.y)
