"""The exit pupil and the magnifications of a render, as they move with the lens."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.kernels.rendering import View
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.system import OpticalSystem
from dolens.rendering.exit_pupil import (
    ExitPupil,
    LimitingAperture,
    limiting_aperture,
    limiting_edge_distance,
)
from dolens.scene.scene import Scene


class DifferentiableGeometry(NamedTuple):
    """The part of a view that moves with the lens: numbers, or tensors with gradients."""

    pupil: ExitPupil
    magnifications: Sequence[float | Tensor]

    @property
    def still(self) -> list[float]:
        """The magnifications without gradients."""
        return [float(m.detach() if isinstance(m, Tensor) else m) for m in self.magnifications]

    def joined(self, system: OpticalSystem) -> Tensor:
        """All of it in one tensor, (3 + planes,), in the lens's precision."""
        return _stacked([*self.pupil, *self.magnifications], system)

    def packed_for_kernel(self, system: OpticalSystem, view: View) -> Tensor:
        """Stack it for `kernels.rendering.render`, with a sample's share for the axial radius."""
        share = sample_weight(system, view, self.pupil)
        return _stacked([*self.pupil[:2], share, *self.magnifications], system)

    def of(self, joined: Tensor) -> "DifferentiableGeometry":
        """The inverse of `joined`; the numbers themselves where nothing moves."""
        if not joined.requires_grad:
            return self
        values = joined.unbind()
        return DifferentiableGeometry(ExitPupil(*values[:3]), values[3:])


def _stacked(values: Sequence[float | Tensor], system: OpticalSystem) -> Tensor:
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    return torch.stack([torch.as_tensor(v, **options) for v in values])


def differentiable_geometry(
    system: OpticalSystem, scene: Scene, view: View
) -> DifferentiableGeometry:
    """The pupil and the magnifications of a view, with gradients where the lens has any."""
    pupil = ExitPupil(view.pupil_z, view.pupil_radius, view.axial_radius)
    pupil = differentiable_exit_pupil(system, scene.wavelengths, pupil)
    return DifferentiableGeometry(pupil, scene.differentiable_magnifications(system))


def sample_weight(system: OpticalSystem, view: View, pupil: ExitPupil) -> Tensor:
    """Weight of a sample over cos⁴ of its ray's angle, so that they sum to one on the axis."""
    larger = (pupil.radius / pupil.axial_radius) ** 2
    return larger / (pupil.axial_mean(system.vertices[-1]) * view.pupil_samples**2)


def depends_on_parameters(system: OpticalSystem) -> bool:
    """Return whether gradients with respect to any of a lens's parameters are wanted."""
    if not torch.is_grad_enabled():
        return False
    tensors = [system.sensor_distance, *system.thicknesses]
    tensors += [offset for offset in system.index_offsets if offset is not None]
    for surface in system.surfaces:
        tensors += surface.parameters.values()
        if surface.edge is not None:
            tensors.append(surface.edge)
    for element in system.elements:
        tensors += element.parameters.values()
    return any(tensor.requires_grad for tensor in tensors)


def differentiable_exit_pupil(
    system: OpticalSystem, wavelengths: Sequence[float], pupil: ExitPupil
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

    Returns:
        The pupil itself where the lens asks for no gradient, else tensors of the lens's precision.
    """
    pupil = pupil.numbers()
    if not depends_on_parameters(system):
        return pupil
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    z, ratio = _pupil_plane(system, wavelengths, pupil)
    axial = torch.tensor(pupil.axial_radius, **options)
    limit = limiting_aperture(system, wavelengths, pupil.z, pupil.axial_radius)
    if limit is not None:
        axial = _radius(system, limit, axial, z)
    elif ratio is not None:
        # No edge ends the beam: the search for the disc ended at the paraxial pupil.
        axial = axial * ratio
    return ExitPupil(z, axial * (pupil.radius / pupil.axial_radius), axial)


def differentiable_chief_pupil(
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


def _radius(system: OpticalSystem, limit: LimitingAperture, radius: Tensor, z: Tensor) -> Tensor:
    """The axial radius as a function of the lens, by the implicit function theorem."""
    reach = radius.detach().requires_grad_()
    distance = limiting_edge_distance(system, limit, reach, z)
    (slope,) = torch.autograd.grad(distance, reach, retain_graph=True)
    if not bool(slope != 0.0):
        return radius
    return radius - (distance - distance.detach()) / slope
