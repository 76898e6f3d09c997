"""Planes: refracting, and the aperture that only stops light."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.optics.surfaces.base import Hit, Parameters, PlaneRay, Surface


class Plane(Surface):
    """A flat refracting surface; it has no parameters."""

    kind = "plane"

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """A plane has no parameters."""
        return []

    @staticmethod
    def sag_and_gradient(p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Zero sag and slopes, everywhere."""
        zero = torch.zeros_like(x + y)
        return zero, zero, zero, torch.ones_like(zero, dtype=torch.bool)

    @classmethod
    def intersect(cls, p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
        """The ray is there already."""
        return Hit(torch.zeros_like(ray.n), 0.0, 0.0, 1.0, sense * ray.n > 0.0)

    @staticmethod
    def paraxial_curvature(p: Parameters) -> Tensor:
        """Zero."""
        return torch.zeros(())


class Aperture(Plane):
    """A plane stop: it clips, and does not refract (except behind an `occluder` medium)."""

    kind = "aperture"
