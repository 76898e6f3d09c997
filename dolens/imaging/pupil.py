"""The exit pupil that the renderer aims at."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.backend import trace_rays
from dolens.optics.paraxial import exit_pupil
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import trace_surfaces

_AZIMUTHS = 16
_RADII = 64


class ExitPupil(NamedTuple):
    """A disc that every axial pixel sees filled with light: z from the first vertex, radius, mm."""

    z: float
    radius: float


def aim(
    x: Tensor, y: Tensor, sensor_z: Tensor, pupil_x: Tensor, pupil_y: Tensor, pupil_z: float
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
def axial_exit_pupil(
    system: OpticalSystem, wavelengths: Sequence[float], backend: str = "reference"
) -> ExitPupil:
    """The largest disc in the paraxial exit pupil's plane that real axial rays fill.

    Rays from the sensor's centre are traced backwards at many radii and azimuths, and again in
    between to narrow the first radius that fails, for every wavelength.  Sampling this disc, and
    no larger one, lets every axial sample through, so that a white scene renders white.

    Args:
        system: the lens.
        wavelengths: nm.
        backend: what traces: `reference`, `cpu` or `cuda`.

    Raises:
        InputError: no ray from the sensor's centre gets through.
    """
    z = float(exit_pupil(system, wavelengths[len(wavelengths) // 2]).z)
    options = {"dtype": system.dtype, "device": system.device}
    sensor_z = system.vertices[-1]
    distance = abs(z - float(sensor_z))
    paraxial = min(float(exit_pupil(system, w).diameter) / 2.0 for w in wavelengths)
    angle = torch.arange(_AZIMUTHS, **options) * (2.0 * math.pi / _AZIMUTHS)
    origin = torch.zeros((), **options)
    # The stop's paraxial image may be far larger than what other apertures let through.
    low, high = 0.0, min(2.0 * paraxial, 100.0 * distance)
    for _ in range(3):
        radii = torch.linspace(low, high, _RADII, **options)[:, None]
        ray = aim(origin, origin, sensor_z, radii * torch.cos(angle), radii * torch.sin(angle), z)
        passes = _get_through(system, ray, wavelengths, backend)
        failing = torch.nonzero(~passes.all(dim=1)).flatten()
        if len(failing) == 0:
            return ExitPupil(z, high)
        first = int(failing[0])
        if first == 0:
            raise InputError(
                "no light reaches the centre of the sensor: every axial ray is stopped"
            )
        low, high = float(radii[first - 1]), float(radii[first])
    return ExitPupil(z, low)


def _get_through(
    system: OpticalSystem, ray: Components, wavelengths: Sequence[float], backend: str
) -> Tensor:
    """Which rays get through the lens backwards, at every wavelength."""
    if backend == "reference":
        passes = [trace_surfaces(system, ray, w, sense=-1.0).valid for w in wavelengths]
        return torch.stack(passes).all(dim=0)
    every = torch.tensor(wavelengths, dtype=torch.float64, device=system.device)[:, None, None]
    rays = Rays.from_components(ray, every)
    hit = trace_rays(system, rays, backend, -1.0, record=False, first=1, last=None)
    return hit.valid.all(dim=0)
