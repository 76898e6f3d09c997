"""The pupil and the magnifications of a render, with gradients, and the weight of its samples."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.kernels.view import View
from dolens.optics.system import OpticalSystem
from dolens.rendering.pupil.differentiable_pupil import differentiable_exit_pupil
from dolens.rendering.pupil.exit_pupil import ExitPupil
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
