"""The exit pupil that renderers aim at, the aperture that limits it, and its F-number."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.paraxial_rays import Number, ParaxialNumbers
from dolens.optics.ray_tracing import trace_components, trace_rays
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem, require_plane_sensor, require_refracting
from dolens.optics.trace import trace_surfaces
from dolens.sensor.pixels import Sensor

_AZIMUTHS = 16
_RADII = 64


# A larger disc is sampled only for more light than this share of what a corner gets.
_NEGLIGIBLE = 2e-3
# Radii, over the axial one, at which that light is looked for: the crescent may be a thin one.
_LARGEST, _FINE_RADII = 2.0, 256
# A larger disc is wider than what was found by this factor, and by whole shares 1/_STEPS.
_ROOM, _STEPS = 1.01, 32


class ExitPupil(NamedTuple):
    """A disc through which light reaches the sensor: z from the first vertex and radii, mm.

    Numbers, or tensors whose gradients follow the lens
    (`differentiable_pupil.differentiable_exit_pupil`).

    Attributes:
        z: of the paraxial exit pupil.
        radius: of the disc that holds the light of every pixel.
        axial_radius: of the disc that pixels on the axis see filled.
    """

    z: Number
    radius: Number
    axial_radius: Number

    def numbers(self) -> "ExitPupil":
        """The same without gradients."""
        return ExitPupil(*(float(v.detach() if isinstance(v, Tensor) else v) for v in self))

    def axial_mean(self, sensor_z: Number) -> Number:
        """The mean of cos⁴ over the axial disc of radius a at distance L from a sensor plane, as
        an axial pixel sees it: L²/(L² + a²).
        """
        squared = (sensor_z - self.z) ** 2
        return squared / (squared + self.axial_radius**2)


def paraxial_exit_pupil(system: OpticalSystem, wavelengths: Sequence[float]) -> ExitPupil:
    """The pupil at the middle wavelength, its radius the least of all; no ray is traced.

    Enough for chief rays, which are aimed at its centre.

    Raises:
        InputError: the lens has mirrors, coordinate breaks or a curved sensor.
    """
    require_refracting(system, "rendering")
    require_plane_sensor(system, "rendering")
    first_order = ParaxialNumbers.of(system)
    z, _ = first_order.exit_pupil(wavelengths[len(wavelengths) // 2])
    radius = min(first_order.exit_pupil(w)[1] for w in wavelengths) / 2.0
    return ExitPupil(z, radius, radius)


@torch.no_grad()
def sampled_exit_pupil(
    system: OpticalSystem,
    wavelengths: Sequence[float],
    sensor: Sensor,
    axial: ExitPupil | None = None,
) -> ExitPupil:
    """The disc to be sampled from all pixels of a sensor.

    It is the axial pixels' own, unless the pupil's aberrations let light reach other pixels from
    outside of it: then a larger one, of which axial pixels use a part.  The corners are asked, and
    points halfway to them.

    Args:
        system: the lens.
        wavelengths: nm.
        sensor: the pixels.
        axial: what `axial_exit_pupil` found for this lens; None: it is asked here.

    Raises:
        InputError: no ray from the sensor's centre gets through.
    """
    axial = axial or axial_exit_pupil(system, wavelengths)
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    places = torch.tensor([0.0, 0.25, 0.75, 1.0], **options)
    rows = torch.stack((places, places)).flatten() * sensor.height - 0.5
    columns = torch.stack((places, 1.0 - places)).flatten() * sensor.width - 0.5
    x, y = (p[:, None, None] for p in sensor.positions(rows, columns))
    angle = torch.arange(_AZIMUTHS, **options) * (2.0 * math.pi / _AZIMUTHS)
    share = (torch.arange(_FINE_RADII, **options)[:, None] + 0.5) * (_LARGEST / _FINE_RADII)
    radii = share * axial.radius
    ray = rays_to_exit_pupil(
        x, y, system.vertices[-1], radii * torch.cos(angle), radii * torch.sin(angle), axial.z
    )
    passes = _get_through(system, ray, wavelengths[len(wavelengths) // 2 :][:1])
    light = torch.where(passes, share, 0.0)
    outside = torch.where(share > 1.0, light, 0.0)
    lost = outside.sum((-2, -1)) / light.sum((-2, -1)).clamp(min=torch.finfo(light.dtype).tiny)
    if float(lost.max()) <= _NEGLIGIBLE:
        return axial
    farthest = float(torch.where(passes, share, 0.0).max()) + 0.5 * _LARGEST / _FINE_RADII
    # Room for other colours and azimuths, and steps that hardly any change of the lens passes.
    larger = math.ceil(_ROOM * farthest * _STEPS) / _STEPS
    return axial._replace(radius=larger * axial.radius)


@torch.no_grad()
def axial_exit_pupil(system: OpticalSystem, wavelengths: Sequence[float]) -> ExitPupil:
    """The largest disc in the paraxial exit pupil's plane that real axial rays fill.

    Rays from the sensor's centre are traced backwards at many radii and azimuths, and again in
    between to narrow the first radius that fails, for every wavelength.  Where an aperture's edge
    ends them, the radius is that of the ray that grazes it, so that it is a smooth function of the
    lens.  Sampling this disc, and no larger one, lets every axial sample through, so that a white
    scene renders white.

    Args:
        system: the lens.
        wavelengths: nm.

    Raises:
        InputError: no ray from the sensor's centre gets through.
    """
    z, paraxial, _ = paraxial_exit_pupil(system, wavelengths)
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    sensor_z = system.vertices[-1]
    distance = abs(z - float(sensor_z))
    angle = torch.arange(_AZIMUTHS, **options) * (2.0 * math.pi / _AZIMUTHS)
    origin = torch.zeros((), **options)
    # The stop's paraxial image may be far larger than what other apertures let through.
    low, high = 0.0, min(2.0 * paraxial, 100.0 * distance)
    for _ in range(3):
        radii = torch.linspace(low, high, _RADII, **options)[:, None]
        ray = rays_to_exit_pupil(
            origin, origin, sensor_z, radii * torch.cos(angle), radii * torch.sin(angle), z
        )
        passes = _get_through(system, ray, wavelengths)
        failing = torch.nonzero(~passes.all(dim=1)).flatten()
        if len(failing) == 0:
            return ExitPupil(z, high, high)
        first = int(failing[0])
        if first == 0:
            raise InputError(
                "no light reaches the centre of the sensor: every axial ray is stopped"
            )
        low, high = float(radii[first - 1]), float(radii[first])
    limit = limiting_aperture(system, wavelengths, z, low)
    if limit is not None:
        low = limiting_pupil_radius(system, limit, z, low, high)
    return ExitPupil(z, low, low)


def _get_through(system: OpticalSystem, ray: Components, wavelengths: Sequence[float]) -> Tensor:
    """Return which rays get through the lens backwards, at every wavelength."""
    every = torch.tensor(wavelengths, dtype=torch.float64, device=system.device)
    _, valid = trace_components(system, ray, every.reshape(-1, *(1,) * ray.x.ndim), -1.0)
    return valid.all(dim=0)


def working_f_number(pupil: ExitPupil, sensor_z: Number) -> Number:
    """1/(2·sin u') of the axial beam, u' the angle of its edge in air; a tensor where any is."""
    square = ((sensor_z - pupil.z) / pupil.axial_radius) ** 2 + 1.0
    return 0.5 * square**0.5


_BEAM_AZIMUTHS = 16
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
    count = 1 if system.rotationally_symmetric else _BEAM_AZIMUTHS
    angle = torch.arange(count, **options) * (2.0 * math.pi / _BEAM_AZIMUTHS)
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


def rays_to_exit_pupil(
    x: Tensor,
    y: Tensor,
    sensor_z: Tensor,
    pupil_x: Tensor,
    pupil_y: Tensor,
    pupil_z: float | Tensor,
) -> Components:
    """Rays from points of the sensor towards points of the pupil plane, travelling towards -z.

    A pupil behind the sensor is virtual: the rays then travel away from its points.
    """
    dx, dy, dz = pupil_x - x, pupil_y - y, pupil_z - sensor_z
    inverse = torch.rsqrt(dx * dx + dy * dy + dz * dz)
    inverse = torch.where(dz > 0.0, -inverse, inverse)
    z = sensor_z.expand(inverse.shape)
    return Components(
        x.expand(inverse.shape),
        y.expand(inverse.shape),
        z,
        dx * inverse,
        dy * inverse,
        dz * inverse,
    )


@torch.no_grad()
def axial_f_number(lens: Lens) -> float:
    """The F-number that the axial beam works with: N = 1/(2·sin u'), u' the angle of its edge.

    A white Lambertian plane of radiance L gives the axial pixel the irradiance π·L·sin²u', which
    is π·L/(4N²), whatever the plane's distance.  The edge is that of the largest disc in the exit
    pupil which real rays fill, so the surface that limits the beam counts, be it the stop or not.

    Args:
        lens: as its parameters are stored, at its primary wavelength.

    Raises:
        InputError: no ray reaches the sensor's centre.
    """
    system = lens.system()
    pupil = axial_exit_pupil(system, (lens.primary_wavelength,))
    return working_f_number(pupil, float(system.vertices[-1]))
