"""Intercepts of rays from sensor points with a scene's planes, through all of the pupil."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.ray_tracing import say_once, trace_rays
from dolens.optics.rays import Components, Rays, Status, TracedRays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import distance_to_plane
from dolens.rendering.aperture_edges import AZIMUTHS, EdgeRays, edge_rays, pupil_boundary
from dolens.rendering.differentiable_geometry import depends_on_parameters
from dolens.rendering.exit_pupil import rays_to_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem

# Radii of sensor points closer than this share of the largest are one radius.
_SAME_RADIUS = 1e-7


class PlanePoints(NamedTuple):
    """Intercepts of the rays of N sensor points with D planes at C wavelengths, S rays each.

    Attributes:
        rows: (N, D, C, S), rows below the axis in the image of a pinhole, in pixels.
        columns: (N, D, C, S), columns right of the axis.
        weight: (N, 1, C, S), the share of each ray in the irradiance, relative to that of an axial
            pixel that sees white; zero where a ray does not arrive.
    """

    rows: Tensor
    columns: Tensor
    weight: Tensor


def plane_points(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor], disc: tuple[Tensor, Tensor]
) -> PlanePoints:
    """Trace rays from points of the sensor through the exit pupil to the planes of a scene.

    A pixel's irradiance is the mean of radiance · cos⁴ over the exit pupil's disc, as in
    `RayRenderer`.  In a lens of rotational symmetry points of one radius share their rays, turned
    about the axis.

    Where gradients of the lens are wanted and apertures cut the disc, rays along their edges follow
    the samples (`edge_rays`): their weights are zero and have gradients.

    Args:
        imaging: the lens, D depths and C wavelengths, the pupil's disc and the pixels' pitch.
        points: x and y on the sensor, mm, each (N,), double precision, on any device.
        disc: x and y of the rays in the disc, in units of its radius, each (N or 1, S), in the
            frame in which a symmetric lens's point lies on the positive x axis.

    Returns:
        What rays see, on the lens's device.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    x, y = points = _beside(system, points)
    again = None
    if system.rotationally_symmetric:
        # Sorted radii, and which of them each point has.
        radius, again = torch.unique(_rounded(torch.hypot(x, y)), return_inverse=True)
        x, y = radius, torch.zeros_like(radius)
    ray, weight = pupil_rays(imaging, (x, y), disc)
    rim = rim_rays(imaging, (x, y))
    if rim is not None:
        ray = Components(*(torch.cat(pair, -1) for pair in zip(ray, rim.ray, strict=True)))
        weight = torch.cat((weight, rim.weight), -1)
    rows, columns = [], []
    for depth, magnification in zip(
        scene.depths, scene.differentiable_magnifications(system), strict=True
    ):
        t, _ = distance_to_plane(ray, -depth, -1.0)
        scale = magnification / pitch
        columns.append(torch.addcmul(ray.x, t, ray.l) * scale)
        rows.append(torch.addcmul(ray.y, t, ray.m) * -scale)
    row, column = (torch.stack(each).permute(2, 0, 1, 3) for each in (rows, columns))
    weight = weight.permute(1, 0, 2)[:, None]
    if again is None:
        return PlanePoints(row, column, weight)
    # Turned from the positive x axis to where each point lies; rows grow against y.
    angle = torch.atan2(points[1], points[0])
    cosine, sine = (f(angle).reshape(-1, 1, 1, 1).to(row) for f in (torch.cos, torch.sin))
    row, column, weight = (t.index_select(0, again) for t in (row, column, weight))
    return PlanePoints(cosine * row - sine * column, cosine * column + sine * row, weight)


def pupil_rays(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor], disc: tuple[Tensor, Tensor]
) -> tuple[Components, Tensor]:
    """Rays from sensor points through the exit pupil, traced into object space.

    Args:
        imaging: the lens, C wavelengths and the pupil's disc.
        points: x and y on the sensor, mm, each (N,).
        disc: x and y in the disc, in units of its radius, each (N, S).

    Returns:
        The rays in front of the lens, (C, N, S), and their shares in the irradiance relative to
        that of an axial pixel: cos⁴ over its mean over the axial disc; zero where one is lost.  Of
        a lens with coatings they are less, by what it loses.
    """
    system, pupil = imaging.system, imaging.pupil
    sensor_z = system.vertices[-1]
    x, y = (p.to(sensor_z.dtype)[:, None] for p in points)
    disc_x, disc_y = (d[: len(x)] * pupil.radius for d in disc)
    ray = rays_to_exit_pupil(x, y, sensor_z, disc_x, disc_y, pupil.z)
    there, valid, passed = _before_the_lens(system, ray, imaging.scene.wavelengths)
    share = (pupil.radius / pupil.axial_radius) ** 2
    share = share / (pupil.axial_mean(sensor_z) * disc_x.shape[-1])
    light = ray.n**4 * share
    if passed is not None:
        light = light * passed
    return there, torch.where(valid & (there.n < 0.0), light, 0.0)


def rim_rays(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> EdgeRays | None:
    """Rays (C, N, AZIMUTHS) along the edges that end the light of sensor points.

    None where no edge cuts the disc, or no gradient of the lens is wanted.  Arguments as of
    `pupil_rays`, whose weights those of these rays complement: they are zero and have gradients.
    """
    system, pupil, wavelengths = imaging.system, imaging.pupil, imaging.scene.wavelengths
    if not depends_on_parameters(system):
        return None
    middle = wavelengths[len(wavelengths) // 2]
    found = pupil_boundary(system, middle, points, pupil.numbers())
    if found is None:
        return None
    angle = torch.arange(AZIMUTHS, dtype=system.dtype, device=system.device)
    angle = (angle * (2.0 * math.pi / AZIMUTHS)).expand(len(points[0]), -1)
    arms = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    edge = (found.middle[:, None], arms, found.radius, found.surface)
    return edge_rays(system, wavelengths, points, pupil, edge)


def chief_ray_points(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Find where the chief rays of sensor points meet the planes.

    These go through the centre of the paraxial exit pupil.  Where one of them misses a surface or
    is totally reflected, as in a wide lens whose pupil wanders, all of them go through the centre
    of the stop, and the log says so.  This is the image's geometry: distortion and, between
    wavelengths, lateral colour.

    Args:
        imaging: as in `plane_points`.
        points: x and y, mm, each (N,), on any device.

    Returns:
        Rows and columns from the axis in the image of a pinhole, each (N, D, C), on the lens's
        device.

    Raises:
        InputError: neither ray gets to the planes, so that they say nothing.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    x, y = (p.to(system.dtype) for p in _beside(system, points))
    zero = torch.zeros_like(x)
    ray = rays_to_exit_pupil(x, y, system.vertices[-1], zero, zero, imaging.pupil.z)
    wavelengths = torch.tensor(scene.wavelengths, dtype=torch.float64, device=system.device)
    rays = Rays.from_components(ray, wavelengths[:, None])
    hit = trace_rays(system, rays, -1.0)
    if _any_lost(hit):
        say_once(
            "renderer: chief rays are those through the centre of the stop, since some through "
            "the paraxial exit pupil's do not pass"
        )
        hit = trace_rays(system, rays_through_stop(system, (x, y), wavelengths), -1.0)
    if _any_lost(hit):
        raise InputError(
            "renderer: chief rays of the sensor's outer pixels do not pass the lens, which leaves "
            "its distortion undefined; use registration=pinhole, renderer=rays or a smaller sensor"
        )
    there = hit.components()
    rows, columns = [], []
    for depth, magnification in zip(
        scene.depths, scene.differentiable_magnifications(system), strict=True
    ):
        t, _ = distance_to_plane(there, -depth, -1.0)
        scale = magnification / pitch
        columns.append(torch.addcmul(there.x, t, there.l) * scale)
        rows.append(torch.addcmul(there.y, t, there.m) * -scale)
    return torch.stack(rows).permute(2, 0, 1), torch.stack(columns).permute(2, 0, 1)


def _any_lost(hit: TracedRays) -> bool:
    return bool(((hit.status == Status.TIR) | (hit.status == Status.MISSED)).any())


# Steps from the axis to a point of the sensor, and Newton's iterations at each.
_AIMING_STEPS, _CORRECTIONS = 16, 3
# For central differences in double precision.
_SLOPE_STEP = 1e-5


def rays_through_stop(
    system: OpticalSystem, points: tuple[Tensor, Tensor], wavelengths: Tensor
) -> Rays:
    """Return the rays from sensor points whose way back goes through the centre of the stop.

    Newton's iteration for the ray's slopes u, with F(u) = 0 where it meets the stop, from the axis
    outwards.  A last step within the autograd graph, u - J⁻¹·F(u), has the implicit derivatives.

    Args:
        system: the lens.
        points: x and y, mm, each (N,).
        wavelengths: (C,), nm.

    Returns:
        (C, N), at the sensor, travelling towards -z; those for which no ray is found go astray.
    """
    exact = system.double().opened()
    place = torch.stack(points).double().detach()[:, None].expand(2, len(wavelengths), -1)
    before = slopes = torch.zeros_like(place)
    with torch.no_grad():
        for step in range(_AIMING_STEPS + 1):
            share = step / _AIMING_STEPS
            guess = 2.0 * slopes - before
            before = slopes
            slopes = guess
            for _ in range(_CORRECTIONS):
                slopes = _corrected(exact, share * place, slopes, wavelengths)
    slopes = _corrected(exact, place, slopes, wavelengths)
    return Rays.from_components(_leaving(system, place, slopes), wavelengths[:, None])


def _leaving(system: OpticalSystem, place: Tensor, slopes: Tensor) -> Components:
    """Rays from the sensor of slopes (2, ...), dx/dz and dy/dz, towards -z."""
    inverse = -torch.rsqrt(1.0 + slopes.square().sum(0))
    (x, y), (l, m) = place.to(system.dtype), (slopes * inverse).to(system.dtype)  # noqa: E741
    return Components(
        x, y, system.vertices[-1].expand(inverse.shape), l, m, inverse.to(system.dtype)
    )


def _corrected(system: OpticalSystem, place: Tensor, slopes: Tensor, wavelengths: Tensor) -> Tensor:
    """Return slopes (2, C, N) after an iteration of Newton's: differentiable in the lens, by where
    rays meet the stop, and not in the slopes, whose derivatives are central differences.
    """
    step = slopes.new_tensor(
        [
            [0.0, 0.0],
            [_SLOPE_STEP, 0.0],
            [-_SLOPE_STEP, 0.0],
            [0.0, _SLOPE_STEP],
            [0.0, -_SLOPE_STEP],
        ]
    )
    slopes = slopes.detach()
    tried = slopes[:, None] + step.mT[..., None, None]
    ray = _leaving(system, place[:, None].expand_as(tried), tried)
    hit = trace_rays(
        system, Rays.from_components(ray, wavelengths[:, None]), -1.0, first=system.stop
    )
    there = Components(*hit.position.unbind(-1), *hit.direction.unbind(-1))
    x, y, *_ = from_lens_axes(there, system.axes[system.stop - 1])
    miss = torch.stack((x, y), -1)
    ends = miss[1:].detach()
    jacobian = torch.stack((ends[0] - ends[1], ends[2] - ends[3]), -1) / (2.0 * _SLOPE_STEP)
    singular = torch.linalg.det(jacobian).abs() <= torch.finfo(jacobian.dtype).tiny
    jacobian = torch.where(singular[..., None, None], torch.eye(2).to(jacobian), jacobian)
    return slopes - torch.linalg.solve(jacobian, miss[0]).movedim(-1, 0)


def distinct_radii(points: tuple[Tensor, Tensor]) -> Tensor:
    """Return the distances from the axis that there are among points, sorted."""
    return torch.unique(_rounded(torch.hypot(*points)))


def pinhole_points(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Find where a pinhole sees sensor points, as `chief_ray_points`: (N, D, C) each."""
    x, y = _beside(imaging.system, points)
    pitch = imaging.sensor.pixel_pitch
    rows, columns = y / pitch, -x / pitch
    shape = (len(x), len(imaging.scene.depths), len(imaging.scene.wavelengths))
    return rows[:, None, None].expand(shape), columns[:, None, None].expand(shape)


def _beside(system: OpticalSystem, points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Points of the sensor on the lens's device."""
    x, y = points
    return x.to(system.device), y.to(system.device)


def _rounded(radius: Tensor) -> Tensor:
    """Radii, equal where they differ by rounding only."""
    unit = float(radius.max()) * _SAME_RADIUS
    if not unit > 0.0 or not math.isfinite(unit):
        return radius
    return torch.round(radius / unit) * unit


def _before_the_lens(
    system: OpticalSystem, ray: Components, wavelengths: Sequence[float]
) -> tuple[Components, Tensor, Tensor | None]:
    """Rays (C, N, S) in object space, which of them got there, and their shares of light."""
    every = torch.tensor(wavelengths, dtype=torch.float64, device=system.device)
    rays = Rays.from_components(ray, every[:, None, None])
    hit = trace_rays(system, rays, -1.0, transmission=system.coated)
    return hit.components(), hit.valid, hit.transmission
