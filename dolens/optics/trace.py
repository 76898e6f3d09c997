"""Sequential tracing, forward and backward (Algorithm 1 of the source)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.rays import Components, Status
from dolens.optics.surfaces.base import Hit, PlaneRay
from dolens.optics.system import OpticalSystem


@dataclass(frozen=True)
class Trace:
    """Rays after the last surface (or on the sensor), as components.

    Attributes:
        ray: z is measured from the vertex of the first surface.
        valid: bool.
        failures: per surface met, its number and the masks missed, outside, reflected.
        path_length: Σ n·t in mm, or None when it was not asked for.
        points: per surface met, x, y, z; empty when not recorded.
    """

    ray: Components
    valid: Tensor
    failures: list[tuple[int, Tensor, Tensor, Tensor | None]]
    path_length: Tensor | None
    points: list[tuple[Tensor, Tensor, Tensor]]


def transfer(ray: Components, distance: Tensor) -> Components:
    """Move rays by a distance (mm) along their direction."""
    x, y, z, l, m, n = ray  # noqa: E741
    return Components(x + distance * l, y + distance * m, z + distance * n, l, m, n)


def distance_to_plane(ray: Components, z: Tensor | float, sense: float) -> tuple[Tensor, Tensor]:
    """Distance (mm) along rays to the plane at z, and where they travel in the given sense.

    Rays that do not travel towards it get the finite distance of a ray along the axis.
    """
    towards = sense * ray.n > 0.0
    return (z - ray.z) / torch.where(towards, ray.n, torch.full_like(ray.n, sense)), towards


def refract(
    ray: PlaneRay, hit: Hit, ratio: float | Tensor, sense: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Snell's law in vector form.

    Args:
        ray: direction cosines of a unit vector.
        hit: unit normal towards +z.
        ratio: index before over index after, in the order of the light's travel.
        sense: +1 forward, -1 backward; the sign of direction · normal.

    Returns:
        The refracted direction d' = μ·d + (s·cos t - μ·cos i)·N, with cos²t = 1 - μ²(1 - cos²i),
        and the mask of rays that are not totally reflected; those that are keep finite numbers.
    """
    _, _, l, m, n = ray  # noqa: E741
    cosine = l * hit.nx + m * hit.ny + n * hit.nz
    squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    transmitted = squared > 0.0
    root = torch.sqrt(torch.where(transmitted, squared, torch.ones_like(squared)))
    along = sense * root - ratio * cosine
    return (
        ratio * l + along * hit.nx,
        ratio * m + along * hit.ny,
        ratio * n + along * hit.nz,
        transmitted,
    )


def trace_surfaces(
    system: OpticalSystem,
    ray: Components,
    wavelength: float | Tensor,
    sense: float = 1.0,
    path_length: bool = False,
    record: bool = False,
) -> Trace:
    """Trace rays through every surface, in the order that light in this sense meets them.

    Args:
        system: the lens.
        ray: one broadcast shape, mm, z from the first vertex.
        wavelength: nm.
        sense: +1 from the object towards the sensor, -1 from the sensor towards the object.
        path_length: whether to sum n·t.
        record: whether to keep the intersections.

    Returns:
        The rays on the last surface met, travelling in the medium behind it.
    """
    indices = system.indices(wavelength)
    vertices = system.vertices
    count = len(system.surfaces)
    order = range(count) if sense > 0 else range(count - 1, -1, -1)
    valid = torch.ones_like(ray.n, dtype=torch.bool)
    path = torch.zeros_like(ray.n) if path_length else None
    failures: list[tuple[int, Tensor, Tensor, Tensor | None]] = []
    points: list[tuple[Tensor, Tensor, Tensor]] = []
    # z is kept relative to the vertex at hand: float32 then errs by the sag's rounding only.
    origin: Tensor | float = 0.0
    for i in order:
        surface = system.surfaces[i]
        before, after = (indices[i], indices[i + 1]) if sense > 0 else (indices[i + 1], indices[i])
        ray = ray._replace(z=ray.z + (origin - vertices[i]))
        origin = vertices[i]
        to_plane, towards = distance_to_plane(ray, 0.0, sense)
        x = ray.x + to_plane * ray.l
        y = ray.y + to_plane * ray.m
        at_plane = PlaneRay(x, y, ray.l, ray.m, ray.n)
        hit = surface.shape.intersect(surface.parameters, at_plane, sense, surface.semi_diameter)
        met = towards & hit.met
        t = torch.where(met, hit.t, torch.zeros_like(hit.t))
        x, y, z = x + t * ray.l, y + t * ray.m, t * ray.n
        inside = x * x + y * y < surface.semi_diameter**2
        if path is not None:
            path = path + before * (to_plane + t)
        if record:
            points.append((x, y, z + vertices[i]))
        transmitted = None
        l, m, n = ray.l, ray.m, ray.n  # noqa: E741
        passing = met
        if system.materials[i] != system.materials[i + 1]:
            *bent, transmitted = refract(at_plane, hit, before / after, sense)
            passing = met & transmitted
            l, m, n = (  # noqa: E741
                torch.where(passing, new, old) for new, old in zip(bent, (l, m, n), strict=True)
            )
        failures.append((i + 1, ~met, ~inside, None if transmitted is None else ~transmitted))
        valid = valid & passing & inside
        ray = Components(x, y, z, l, m, n)
    ray = ray._replace(z=ray.z + origin)
    return Trace(ray, valid, failures, path, points)


def trace_to_plane(
    system: OpticalSystem,
    traced: Trace,
    z: Tensor | float,
    wavelength: float | Tensor,
    sense: float,
) -> Trace:
    """Carry rays on from the last surface to the plane at z (mm from the first vertex).

    Rays that do not travel towards it are no longer valid.
    """
    distance, towards = distance_to_plane(traced.ray, z, sense)
    path = traced.path_length
    if path is not None:
        path = path + system.indices(wavelength)[-1 if sense > 0 else 0] * distance
    return Trace(
        transfer(traced.ray, distance),
        traced.valid & towards,
        [*traced.failures, (len(system.surfaces) + 1, ~towards, torch.zeros_like(towards), None)],
        path,
        traced.points,
    )


def first_failure(traced: Trace) -> tuple[Tensor, Tensor]:
    """Status (int8) of every ray and the surface where that happened (int16, 0 if valid).

    A miss or a total reflection ends a ray, so the first of them is its status.  A vignetted ray
    is traced on as if unclipped and is VIGNETTED, at the first aperture that it fails, when
    nothing ends it.  A ray that leaves the last surface away from the sensor missed surface N + 1.
    """
    status = torch.zeros_like(traced.valid, dtype=torch.int8)
    surface = torch.zeros_like(traced.valid, dtype=torch.int16)
    traced_on = torch.ones_like(traced.valid)
    for number, missed, outside, reflected in traced.failures:
        clipped = traced_on & outside & ~missed & (status == Status.OK)
        status = status.masked_fill(clipped, int(Status.VIGNETTED))
        surface = surface.masked_fill(clipped, number)
        for cause, mask in ((Status.MISSED, missed), (Status.TIR, reflected)):
            if mask is not None:
                ends = traced_on & mask
                status = status.masked_fill(ends, int(cause))
                surface = surface.masked_fill(ends, number)
                traced_on = traced_on & ~mask
    return status, surface


def stop_gradient_where_invalid(values: Tensor, valid: Tensor) -> Tensor:
    """The same numbers; those of invalid rays pass no gradient."""
    return torch.where(valid, values, values.detach())
