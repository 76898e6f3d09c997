"""Ray intercepts on the sensor are computed for many fields and wavelengths, by points of the stop;
ray fans are those along two of its diameters.

Aiming a ray at a point of the stop costs far more than tracing it.  A few dozen rays are therefore
aimed, their starting points are fitted by a polynomial in the stop coordinates, and thousands of
rays start at values of the polynomial.  Each is exactly a ray of its field.  The error of the fit
moves its crossing of the stop by some 1e-4 of the stop's semi-diameter or less.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.pupil_quadrature import circle_points
from dolens.errors import InputError
from dolens.optics.aiming import AimedRays, field_line, launch
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import vignetting_margin
from dolens.optics.image_surface import TangentPlanes
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays, Status
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem

_DEGREE = 8
# Rings and azimuths of the points that are aimed at; they determine a polynomial of that degree.
_RINGS, _AZIMUTHS = _DEGREE // 2, 2 * _DEGREE + 1
# Rays of fans are aimed; one that crosses the very rim is outside the stop's aperture.
_FAN_RIM = 1.0 - 1e-9


@dataclass(frozen=True)
class RayIntercepts:
    """A `RayIntercepts` holds the sensor intercepts of rays of F fields and W wavelengths through N
    points of the stop.

    Attributes:
        points: (F, W, N, 2), mm, double precision on the CPU like all of these; NaN where a ray
            does not pass.  On a curved sensor distances from the chief ray's point are those in
            the plane that touches it there.
        valid: (F, W, N), bool.
        light: (F, W, N), zero where a ray does not pass, else one, or of a lens with coatings the
            share of unpolarised light that arrives.
        chief: (F, 2), mm, intercepts of the chief rays of the reference wavelength, whether
            apertures clip them or not; NaN where one does not reach the sensor.
    """

    points: Tensor
    valid: Tensor
    light: Tensor
    chief: Tensor


@dataclass(frozen=True)
class AimedAtStop:
    """Rays of F fields and W wavelengths are aimed at points of the stop, to be traced or to be
    fitted.

    Attributes:
        points: (N, 2), on the stop over its semi-diameter; the first is its centre.
        rays: (F, W, N); the reference wavelength is one of the W, or one more at the end.
        reference: which of them it is.
    """

    points: Tensor
    rays: AimedRays
    reference: int


@torch.no_grad()
def aimed_at_stop(lens: Lens, where: Conditions, pupil: Tensor | None = None) -> AimedAtStop:
    """Aim rays at the centre of the stop and other points, separately for every wavelength.

    Args:
        lens: of any precision.
        where: fields, wavelengths and object distance.
        pupil: (N, 2); None: few, which determine all others.
    """
    lens = in_double_precision(lens)
    field, waves = where.fields.to(lens.device), where.wavelengths.to(lens.device)
    # The chief ray of the reference wavelength is always one of the rays.
    reference = torch.nonzero(waves == where.reference_wavelength).flatten()
    at = int(reference[0]) if len(reference) else len(waves)
    if at == len(waves):
        waves = torch.cat([waves, waves.new_tensor([where.reference_wavelength])])
    centre = field.new_zeros(1, 2)
    points = _nodes().to(field) if pupil is None else torch.cat([centre, pupil.to(field)])
    rays = lens.aim(field[:, None, None], points, waves[:, None], where.object_distance)
    return AimedAtStop(points, rays, at)


@torch.no_grad()
def trace_ray_intercepts(
    lens: Lens,
    where: Conditions,
    pupil: Tensor,
    exact: bool = False,
    aimed: AimedAtStop | None = None,
) -> RayIntercepts:
    """Aim rays at points of the stop, separately for every wavelength, and trace them together.

    Args:
        lens: of any precision; the rays are traced in double precision.
        where: fields, wavelengths and object distance.
        pupil: (N, 2), x and y on the stop over its semi-diameter, in the unit disc.

    Rarely needed:
        exact: aim every ray, rather than to fit a few.
        aimed: `aimed_at_stop` of the same lens and conditions, where several analyses share it.
    """
    launched = launch_through_stop(lens, where, pupil, exact, aimed)
    system = in_double_precision(lens).system()
    hit = trace_rays(system, launched.rays, transmission=system.coated)
    chief = trace_rays(system, launched.chief)
    valid = hit.valid & launched.started
    reached = (chief.status == Status.OK) | (chief.status == Status.VIGNETTED)
    reached = reached & launched.chief_started
    points = hit.position[..., :2]
    if system.image is not None:
        points = _along_surface(system, system.image, hit.position, chief.position, reached)
    return RayIntercepts(
        points.where(valid[..., None], math.nan).cpu(),
        valid.cpu(),
        (valid if hit.transmission is None else valid * hit.transmission).double().cpu(),
        chief.position[..., :2].where(reached[..., None], math.nan).cpu(),
    )


@dataclass(frozen=True)
class StopRays:
    """Holds rays in front of a lens, of F fields and W wavelengths, through N points of the stop.

    Attributes:
        rays: (F, W, N), in double precision on the lens's device, as all of these.
        started: (F, W, N), bool: the ray belongs to the field's beam; the numbers of others mean
            nothing.
        chief: (F,), chief rays of the reference wavelength.
        chief_started: (F,), bool.
    """

    rays: Rays
    started: Tensor
    chief: Rays
    chief_started: Tensor


@torch.no_grad()
def launch_through_stop(
    lens: Lens,
    where: Conditions,
    pupil: Tensor,
    exact: bool = False,
    aimed: AimedAtStop | None = None,
) -> StopRays:
    """Aim rays at points of the stop, in front of the lens; arguments of `trace_ray_intercepts`."""
    lens = in_double_precision(lens)
    field, waves = where.fields.to(lens.device), where.wavelengths.to(lens.device)
    pupil = pupil.to(field)
    count = len(waves)
    aimed = aimed or aimed_at_stop(lens, where, pupil if exact else None)
    found, at = aimed.rays, aimed.reference
    reference = waves.new_tensor(where.reference_wavelength)
    chief_rays = Rays(found.position[:, at, 0], found.direction[:, at, 0], reference)
    if exact:
        rays = Rays(found.position[:, :count, 1:], found.direction[:, :count, 1:], waves[:, None])
        started = found.converged[:, :count, 1:]
    else:
        rays, started = _fitted(where, found, aimed.points, pupil)
        rays = Rays(rays.position[:, :count], rays.direction[:, :count], waves[:, None])
        started = started[:, :count, None]
    beam = (vignetting_margin(lens.fields, field, pupil) > 0.0)[:, None]
    return StopRays(rays, started & beam, chief_rays, found.converged[:, at, 0])


def _along_surface(
    system: OpticalSystem, image: SurfaceState, points: Tensor, chief: Tensor, reached: Tensor
) -> Tensor:
    """Return points (F, W, N, 3) of a curved sensor as x and y in the plane that touches it where
    the chief ray (F, 3) lands, from that point's own x and y on.
    """
    there = torch.where(reached[:, None], chief, 0.0)[..., :2]
    planes = TangentPlanes.at(image, there).unsqueeze(1).unsqueeze(1)
    away = points - system.vertices[-1] * points.new_tensor([0.0, 0.0, 1.0]) - planes.point
    return planes.turned(away)[..., :2] + planes.point[..., :2]


@dataclass(frozen=True)
class RayFans(AtConditions):
    """A `RayFans` holds transverse ray aberrations of F fields and W wavelengths at P points of the
    stop.

    Attributes:
        coordinate: (P,), from -1 to 1, over the stop's semi-diameter.
        tangential_um: (F, W, P), µm: y on the sensor, less the chief ray's of the reference
            wavelength, of rays through (0, coordinate); NaN where a ray does not pass.
        sagittal_um: (F, W, P), µm: the same in x, of rays through (coordinate, 0).
    """

    coordinate: Tensor
    tangential_um: Tensor
    sagittal_um: Tensor


@torch.no_grad()
def ray_fans(lens: Lens, where: Conditions, count: int = 41) -> RayFans:
    """Trace fans along y and x of the stop: tangential and sagittal for fields in the y-z plane.

    Every ray is aimed at its own wavelength.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.
        count: points along each diameter; an odd number holds the centre.

    Raises:
        InputError: fewer than two points.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 points along a diameter, not {count}")
    coordinate = torch.linspace(-1.0, 1.0, count, dtype=torch.float64)
    along, across = _FAN_RIM * coordinate, torch.zeros_like(coordinate)
    pupil = torch.cat([torch.stack((across, along), -1), torch.stack((along, across), -1)])
    intercepts = trace_ray_intercepts(lens, where, pupil, exact=True)
    deviation = 1e3 * (intercepts.points - intercepts.chief[:, None, None])
    return RayFans(
        where=where,
        coordinate=coordinate,
        tangential_um=deviation[..., :count, 1],
        sagittal_um=deviation[..., count:, 0],
    )


def _fitted(
    where: Conditions, aimed: AimedRays, nodes: Tensor, pupil: Tensor
) -> tuple[Rays, Tensor]:
    """Return rays (F, W, N) from a fit of aimed ones (F, W, nodes), and whether there is a fit, (F,
    W).
    """
    field, near = where.fields.to(pupil), vergence(where.object_distance)
    line, _ = field_line(torch.deg2rad(field) if near == 0.0 else field, where.object_distance)
    line = line[:, None, None]
    # Where the rays cross the plane that faces the field, in its axes: the inverse of `launch`.
    tilt = line[..., :2] / (1.0 + line[..., 2:])
    start = aimed.position[..., :2] - tilt * aimed.position[..., 2:]

    basis, wanted = _basis(nodes), _basis(pupil)
    ok = aimed.converged
    if bool(ok.all()):
        coefficients = torch.linalg.pinv(basis) @ start
    else:
        # Rays that a lens does not let reach the stop are left out; the least norm fills in.
        part = basis * ok[..., None]
        coefficients = torch.linalg.pinv(part, rtol=1e-10) @ torch.where(ok[..., None], start, 0.0)
    found = ok.sum(-1) > 0
    ray = launch(line, near, wanted @ coefficients)
    return Rays.from_components(ray, aimed.wavelength), found


def _nodes() -> Tensor:
    """Return the centre and rings of Chebyshev radii, (1 + rings·azimuths, 2)."""
    rings = [torch.zeros(1, 2, dtype=torch.float64)]
    for ring in range(_RINGS):
        radius = math.cos(0.5 * math.pi * ring / (_RINGS + 0.5))
        # Every other ring is turned by half a step, so that no azimuth is met by all.
        rings.append(radius * circle_points(_AZIMUTHS, 0.5 * (ring % 2)))
    return torch.cat(rings)


def _basis(points: Tensor) -> Tensor:
    """Return products of Chebyshev polynomials in x and y up to the total degree, (N, terms)."""
    angle = torch.arccos(points.clamp(-1.0, 1.0))[..., None]
    along_x, along_y = torch.cos(angle * torch.arange(_DEGREE + 1).to(points)).unbind(1)
    terms = [
        along_x[:, i] * along_y[:, j] for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)
    ]
    return torch.stack(terms, -1)
