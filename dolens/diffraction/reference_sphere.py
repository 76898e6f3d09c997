"""Spheres about points of the sensor: wavefronts are measured on them, and light spreads from them.

A sphere is given by its centre Q and its curvature κ = 1/R.  Everything is written so that no large
number enters and κ = 0, a sphere of infinite radius, is like any other; a negative κ is a sphere
behind the sensor, about a virtual pupil.
"""

import torch
from torch import Tensor

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.errors import InputError
from dolens.optics.aiming import AimedRays, aim
from dolens.optics.image_surface import TangentPlanes
from dolens.optics.paraxial import exit_pupil
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import TracedRays
from dolens.optics.surfaces import GRAZING
from dolens.optics.system import OpticalSystem


def to_sphere(away: Tensor, direction: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Carry rays back from the sensor to a reference sphere.

    A ray that meets the sensor at e from Q with direction d crosses the sphere a distance t before,
    |e - t·d| = R.  With h² = e² - (e·d)²

        t - R = e·d - κh²/(1 + √(1 - κ²h²)),
        α     = (κ·e·d + √(1 - κ²h²))·d - κ·e.

    Args:
        away: (..., 2), e in mm.
        direction: (..., 3), d.
        curvature: (...), κ in 1/mm.

    Returns:
        t - R (...), mm; x and y (..., 2) of α, the unit vector from the crossing towards Q; and
        bool (...), whether the ray meets the sphere.  Where it does not, the numbers are finite.
    """
    ex, ey = away.unbind(-1)
    l, m, _ = direction.unbind(-1)  # noqa: E741
    along = ex * l + ey * m
    h2 = (ex * ex + ey * ey - along * along).clamp(min=0.0)
    squared = 1.0 - curvature * curvature * h2
    root = squared.clamp(min=1e-9).sqrt()
    scale = curvature * along + root
    alpha = torch.stack((scale * l - curvature * ex, scale * m - curvature * ey), -1)
    return along - curvature * h2 / (1.0 + root), alpha, squared.detach() > 1e-9


def on_tangent_planes(
    system: OpticalSystem, hit: TracedRays, centre: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Carry rays from a curved sensor to the planes that touch it at centres.

    Args:
        system: with a curved sensor.
        hit: (N, ..., 3), rays on it.
        centre: (N, 2), mm.

    Returns:
        x and y (N, ..., 2), mm, from the centre, and directions (N, ..., 3), both in the planes'
        axes (see `TangentPlanes`); and the distance that rays were carried, mm.
    """
    assert system.image is not None
    planes = TangentPlanes.at(system.image, centre)
    for _ in range(hit.position.ndim - 2):
        planes = planes.unsqueeze(1)
    vertex = torch.nn.functional.pad(system.vertices[-1].reshape(1), (2, 0))
    away = planes.turned(hit.position - vertex - planes.point)
    direction = planes.turned(hit.direction)
    cosine = direction[..., 2]
    grazing = cosine.abs() < GRAZING
    distance = -away[..., 2] / torch.where(grazing, torch.ones_like(cosine), cosine)
    return away[..., :2] + distance[..., None] * direction[..., :2], direction, distance


def path_beyond(alpha_rho: Tensor, rho_squared: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    """Return how much further than Q a point of the sensor is from a point of the sphere.

    From the sphere's point Q - R·α to Q + ρ the distance is D = R·s with s² = 1 + 2κ·α·ρ + κ²ρ².

    Args:
        alpha_rho: α·ρ, mm.
        rho_squared: ρ², mm².
        curvature: κ, 1/mm.

    Returns:
        D - R = (2·α·ρ + κρ²)/(1 + s), mm, and s.
    """
    s = (1.0 + curvature * (2.0 * alpha_rho + curvature * rho_squared)).clamp(min=1e-9).sqrt()
    return (2.0 * alpha_rho + curvature * rho_squared) / (1.0 + s), s


@torch.no_grad()
def sphere_curvature(
    system: OpticalSystem, centre: Tensor, wavelength: float, radius: Tensor | None = None
) -> Tensor:
    """κ of spheres about points of the sensor; no gradient.

    Args:
        system: the lens.
        centre: (N, 2), mm.
        wavelength: nm.
        radius: (N,), mm, or None: to the centre of the paraxial exit pupil, negative where that
            lies behind the sensor; infinite where it lies at infinity.

    Returns:
        (N,), 1/mm.

    Raises:
        InputError: a radius of zero, or the paraxial exit pupil lies in the sensor.
    """
    if radius is None:
        # Against the light's own travel, which goes towards -z behind an odd number of mirrors.
        z = system.vertices[-1]
        if system.image is not None:
            z = z + TangentPlanes.at(system.image, centre).point[:, 2]
        to_pupil = system.senses[-1] * (z - exit_pupil(system, wavelength).z)
        length = torch.sqrt(to_pupil.square() + centre.square().sum(-1))
        radius = length * to_pupil.sign()
    if bool((radius == 0.0).any()):
        raise InputError("a reference sphere needs a radius: the exit pupil lies in the sensor")
    return 1.0 / radius


@torch.no_grad()
def chief_ray_intercepts(system: OpticalSystem, points: ObjectPoints, wavelength: Tensor) -> Tensor:
    """Return the sensor intercepts of chief rays, whether apertures clip them or not.

    Args:
        system: the lens.
        points: N of them, in the lens's precision.
        wavelength: (N,), nm.

    Returns:
        (N, 2), mm on the sensor; no gradient.

    Raises:
        InputError: one does not reach the sensor.
    """
    landed, reached = find_chief_rays(system, points, wavelength)
    if not bool(reached.all()):
        at = int(torch.nonzero(~reached)[0])
        raise InputError(
            f"the chief ray of object point {at} does not reach the sensor; give its centre"
        )
    return landed


@torch.no_grad()
def find_chief_rays(
    system: OpticalSystem, points: ObjectPoints, wavelength: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where chief rays land (N, 2), mm on the sensor, and whether they do (N,), bool.

    Arguments are those of `chief_ray_intercepts`.
    """
    chief = chief_rays(system, points, wavelength)
    hit = trace_rays(system.opened(), chief)
    return hit.position[:, :2], chief.converged & hit.valid


@torch.no_grad()
def chief_rays(system: OpticalSystem, points: ObjectPoints, wavelength: Tensor) -> AimedRays:
    """Return chief rays (N,); arguments are those of `chief_ray_intercepts`."""
    system = system.opened()
    infinite = points.vergence == 0.0
    distance = 1.0 / points.vergence
    finite = torch.where(infinite, torch.ones_like(distance), distance)
    field = torch.where(infinite[:, None], points.slopes.atan(), -points.slopes * finite[:, None])
    return aim(system, field, torch.zeros_like(field), wavelength, distance)
