"""How the exit pupil moves with the lens: the derivative of the disc that renderers sample."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.imaging.pupil import ExitPupil, aim
from dolens.optics.backend import trace_rays
from dolens.optics.elements import from_lens_axes
from dolens.optics.paraxial_numbers import ParaxialNumbers
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import trace_surfaces

_AZIMUTHS = 16
# An axial ray that passes every edge at this share of its semi-diameter is limited by none.
_LIMITED = 1e-2


class _Limit(NamedTuple):
    """What ends the axial beam: a surface's number, the azimuth of the ray, and its wavelength."""

    surface: int
    azimuth: float
    wavelength: float


def depends_on_parameters(system: OpticalSystem) -> bool:
    """Whether gradients with respect to any of a lens's parameters are wanted."""
    if not torch.is_grad_enabled():
        return False
    tensors = [system.sensor_distance, *system.thicknesses]
    for surface in system.surfaces:
        tensors += surface.parameters.values()
        if surface.edge is not None:
            tensors.append(surface.edge)
    for element in system.elements:
        tensors += element.parameters.values()
    return any(tensor.requires_grad for tensor in tensors)


def moving_exit_pupil(
    system: OpticalSystem, wavelengths: Sequence[float], pupil: ExitPupil, backend: str
) -> ExitPupil:
    """The pupil's numbers, with gradients with respect to the lens's parameters.

    z is that of the paraxial exit pupil.  The axial radius r is that of the axial ray that grazes
    the limiting edge: with g(r; θ) its distance from the edge, g = 0 gives
    ∂r/∂θ = -(∂g/∂θ)/(∂g/∂r), at constant z; z moves with the lens as well and is part of θ.  The
    radius of a larger disc keeps its ratio to it.

    Args:
        system: the lens.
        wavelengths: nm.
        pupil: numbers, of this lens or of one that hardly differs.
        backend: what traces.

    Returns:
        The pupil itself where the lens asks for no gradient, else tensors of the lens's precision.
    """
    pupil = pupil.numbers()
    if not depends_on_parameters(system):
        return pupil
    options = {"dtype": system.dtype, "device": system.device}
    z, ratio = _pupil_plane(system, wavelengths, pupil)
    axial = torch.tensor(pupil.axial_radius, **options)
    limit = _limit(system, wavelengths, pupil)
    if limit is not None:
        axial = _radius(system, limit, axial, z, backend)
    elif ratio is not None:
        # No edge ends the beam: the search for the disc ended at the paraxial pupil.
        axial = axial * ratio
    return ExitPupil(z, axial * (pupil.radius / pupil.axial_radius), axial)


def moving_chief_pupil(
    system: OpticalSystem, wavelengths: Sequence[float], pupil: ExitPupil
) -> ExitPupil:
    """The pupil with the gradient of its z alone: enough for chief rays, and no ray is traced."""
    pupil = pupil.numbers()
    if not depends_on_parameters(system):
        return pupil
    return pupil._replace(z=_pupil_plane(system, wavelengths, pupil)[0])


def _pupil_plane(
    system: OpticalSystem, wavelengths: Sequence[float], pupil: ExitPupil
) -> tuple[Tensor, Tensor | None]:
    """z with its gradient, and a one whose gradient is that of the paraxial diameter's logarithm;
    None where that has none.
    """
    z, ratio = torch.tensor(pupil.z, dtype=system.dtype, device=system.device), None
    paraxial = ParaxialNumbers.differentiable(system)
    if paraxial is not None:
        there, diameter = paraxial.exit_pupil(wavelengths[len(wavelengths) // 2])
        if isinstance(there, Tensor):
            z = z + (there - there.detach()).to(z)
        if isinstance(diameter, Tensor):
            ratio = (diameter / diameter.detach()).to(z)
    return z, ratio


@torch.no_grad()
def _limit(system: OpticalSystem, wavelengths: Sequence[float], pupil: ExitPupil) -> _Limit | None:
    """The edge that the rim of the axial disc is nearest to."""
    options = {"dtype": system.dtype, "device": system.device}
    angle = torch.arange(_AZIMUTHS, **options) * (2.0 * math.pi / _AZIMUTHS)
    radius, origin = pupil.axial_radius, torch.zeros((), **options)
    ray = aim(
        origin,
        origin,
        system.vertices[-1],
        radius * torch.cos(angle),
        radius * torch.sin(angle),
        pupil.z,
    )
    nearest, limit = _LIMITED, None
    for wavelength in wavelengths:
        trace = trace_surfaces(system, ray, wavelength, sense=-1.0, record=True)
        for margins, point in zip(trace.margins, trace.points, strict=True):
            depth = _edge_distance(system, margins.number, point)
            share, place = (depth / system.surfaces[margins.number - 1].semi_diameter).min(0)
            if float(share) < nearest:
                nearest = float(share)
                limit = _Limit(margins.number, float(angle[place]), wavelength)
    return limit


def _radius(
    system: OpticalSystem, limit: _Limit, radius: Tensor, z: Tensor, backend: str
) -> Tensor:
    """The axial radius as a function of the lens, by the implicit function theorem."""
    reach = radius.detach().requires_grad_()
    zero = torch.zeros_like(reach)[None]
    cosine, sine = math.cos(limit.azimuth), math.sin(limit.azimuth)
    ray = aim(zero, zero, system.vertices[-1], cosine * reach[None], sine * reach[None], z)
    distance = edge_distances(system, ray, limit.surface, limit.wavelength, backend)[0]
    (slope,) = torch.autograd.grad(distance, reach, retain_graph=True)
    if not bool(slope != 0.0):
        return radius
    return radius - (distance - distance.detach()) / slope


def edge_distances(
    system: OpticalSystem,
    ray: Components,
    surface: int,
    wavelength: float | Tensor,
    backend: str,
) -> Tensor:
    """How far inside a surface's edge rays from the sensor meet it, mm; negative outside.

    Differentiable in the rays and the lens, for rays that other edges would stop as well.

    Args:
        system: the lens.
        ray: from the sensor, travelling towards -z.
        surface: the number of the surface.
        wavelength: nm, a number or a tensor that broadcasts with the rays.
        backend: what traces.
    """
    rays = Rays.from_components(ray, wavelength)
    hit = trace_rays(system.opened(), rays, backend, -1.0, record=False, first=surface, last=None)
    return _edge_distance(system, surface, hit.position.unbind(-1))


def _edge_distance(system: OpticalSystem, surface: int, point: Sequence[Tensor]) -> Tensor:
    zero = torch.zeros_like(point[0])
    here = from_lens_axes(Components(*point, zero, zero, zero), system.axes[surface - 1])
    return system.surfaces[surface - 1].edge_distance(here.x, here.y)
