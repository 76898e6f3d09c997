"""A plane refracts, and an aperture only stops light."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.kernels.operations import safe_sqrt
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.kernels.table import Kind
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
from dolens.optics.surfaces.refraction import PlaneRay, Refraction
from dolens.optics.surfaces.registry import register_surface


@register_surface
class Plane(Surface):
    """The surface is flat, refracts, and has no parameters."""

    kind = "plane"
    flat = True
    kernel = SurfaceKernel(kind=Kind.PLANE)
    rotational = True
    closed_form = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return no names: a plane has no parameters."""
        return []

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return zero sag and slopes, everywhere."""
        zero = torch.zeros_like(x + y)
        return zero, zero, zero, None

    @classmethod
    def intersect(
        cls, p: Parameters, ray: PlaneRay, sense: float, scale: float
    ) -> tuple[Tensor, Tensor | None]:
        """Return zero distance: the ray is there already."""
        return torch.zeros_like(ray.n), None

    @classmethod
    def refract(
        cls,
        p: Parameters,
        point: tuple[Tensor, Tensor, Tensor],
        direction: tuple[Tensor, Tensor, Tensor],
        ratio: float | Tensor,
        sense: float,
    ) -> Refraction:
        """Refract by Snell's law about the axis: l' = μl, m' = μm, n' = s·√(1 - μ²(1 - n²))."""
        l, m, n = direction  # noqa: E741
        squared = (1.0 - ratio * ratio) + (ratio * ratio) * (n * n)
        return Refraction(ratio * l, ratio * m, sense * safe_sqrt(squared), squared.detach())

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return no numbers."""
        return PackedShape(())

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return zero."""
        return 0.0

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return zero."""
        return 0.0


@register_surface
class Aperture(Plane):
    """The surface is a plane stop: it clips, and does not refract (except behind an `occluder`
    medium).
    """

    kind = "aperture"
    flat = True
    kernel = Plane.kernel
    rotational = True
    closed_form = True
