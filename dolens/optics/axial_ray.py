"""The ray along the axis tells from which side light comes behind coordinate breaks."""

from dataclasses import replace

import torch

from dolens.optics.elements import LENS_AXES, change_axes
from dolens.optics.rays import Components
from dolens.optics.surfaces.deflection import Media, Travel
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.system import OpticalSystem, per_radian

# A ray whose cosine to the axis is smaller does not say from which side it comes.
_ALONG = 1e-9


@torch.no_grad()
def reversals(system: OpticalSystem, wavelength: float) -> tuple[int, ...]:
    """Find the breaks that turn the axes so far that light goes the other way along z behind them.

    A ray starts along the axis of the first row and is traced through every surface, whatever its
    aperture.  Where it misses one it goes on as at a plane through the vertex.  It travels towards
    +z or -z of the axes that it comes to, and where that is not what the mirrors before say, the
    last break in between has turned it.

    Args:
        system: the lens; its own reversals do not count.
        wavelength: nm.

    Returns:
        Numbers of breaks.
    """
    if not system.breaks:
        return ()
    system = replace(system.double(), reversals=())
    indices, axes = system.indices(wavelength), system.all_axes
    zero = torch.zeros((), dtype=torch.float64, device=system.device)
    ray, here, sense = Components(zero, zero, zero, zero, zero, zero + 1.0), LENS_AXES, 1.0
    found, last_break = [], None
    for number, place in enumerate(axes, 1):
        at_sensor = number > len(system.surfaces)
        if number in system.breaks:
            last_break = number
            continue
        ray, _ = change_axes(ray, here, place)
        here, n = place, float(ray.n)
        if last_break is not None and sense * n < -_ALONG:
            sense = -sense
            found.append(last_break)
        last_break = None
        if at_sensor:
            break
        leaving = -sense if number in system.mirrors else sense
        if abs(n) > _ALONG:
            ray = _through(system, number, ray, sense, leaving, indices, wavelength)
        sense = leaving
    return tuple(found)


def _through(
    system: OpticalSystem,
    number: int,
    ray: Components,
    sense: float,
    leaving: float,
    indices: list[float | torch.Tensor],
    wavelength: float,
) -> Components:
    """Return a ray behind a surface, in its axes."""
    surface = system.surfaces[number - 1]
    x, y, z, *direction = ray
    l, m, n = direction  # noqa: E741
    x, y = x - z / n * l, y - z / n * m
    p, size = surface.parameters, surface.semi_diameter
    t, met = surface.shape.intersect(p, PlaneRay(x, y, l, m, n), sense, size)
    point = (x + t * l, y + t * m, t * n)
    behind = Components(*point, *direction)
    if surface.deflection is not None:
        before, after = indices[number - 1], indices[number]
        media = Media(before, after, per_radian(wavelength, n))
        *bent, transmitted, _ = surface.deflect(
            point, (l, m, n), media, Travel(sense, leaving, True)
        )
        behind = Components(*point, *bent)
        if transmitted is not None:
            met = transmitted if met is None else torch.minimum(met, transmitted)
    elif system.refracts(number):
        ratio = indices[number - 1] / indices[number]
        *bent, transmitted = surface.shape.refract(p, point, (l, m, n), ratio, leaving)
        behind = Components(*point, *bent)
        met = transmitted if met is None else torch.minimum(met, transmitted)
    finite = all(bool(torch.isfinite(c)) for c in behind)
    if finite and (met is None or bool(met > 0.0)):
        return behind
    flat = n.abs() * leaving
    return Components(x, y, torch.zeros_like(x), l, m, flat)
