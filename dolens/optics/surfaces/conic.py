"""Spheres and conics, met in closed form."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.surfaces.base import Hit, Parameters, PlaneRay, Surface


def conic_sag(c: Tensor, k: Tensor | float, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sag of a conic, s = c·r²/(1 + √(1 - (1+k)c²r²)).

    Args:
        c: curvature, 1/mm.
        k: conic constant.
        r2: x² + y², mm².

    Returns:
        sag (mm), ds/d(r²) = c/(2√(1 - (1+k)c²r²)) (1/mm), and where the branch exists.
    """
    discriminant = 1.0 - (1.0 + k) * c * c * r2
    inside = discriminant > 0.0
    root = torch.sqrt(torch.where(inside, discriminant, torch.ones_like(discriminant)))
    return c * r2 / (1.0 + root), 0.5 * c / root, inside


def conic_distance(
    c: Tensor, k: Tensor | float, ray: PlaneRay, sense: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Distance from the vertex plane to a conic, on the crossing in the direction of `sense`.

    Along the ray, A·t² - 2G·t + F = 0 with F = c(x² + y²), G = n - c(lx + my) and
    A = c(1 + k·n²).  At a root, direction · gradient = G - A·t = ±√D with D = G² - AF, so the
    sign of the root is the sense of crossing.  t = F/(G + s√D) has no cancellation and holds for
    planes; where s·G < 0 the other form (G - s√D)/A is the one without cancellation.

    Returns:
        t (mm), the root √D (1 where there is none), and the mask D > 0.
    """
    x, y, l, m, n = ray  # noqa: E741
    f = c * (x * x + y * y)
    g = n - c * (l * x + m * y)
    a = c * (1.0 + k * n * n)
    discriminant = g * g - a * f
    met = discriminant > 0.0
    root = torch.sqrt(torch.where(met, discriminant, torch.ones_like(discriminant)))
    signed = sense * root
    forward = sense * g > 0.0
    denominator = torch.where(forward, g + signed, a)
    safe = met & (denominator != 0.0)
    denominator = torch.where(safe, denominator, torch.ones_like(denominator))
    return torch.where(forward, f, g - signed) / denominator, root, safe


class Conic(Surface):
    """A conic of revolution with curvature c (1/mm) and conic constant k (S1 without a_2i)."""

    kind = "conic"

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Curvature and conic constant."""
        return ["curvature", "conic"]

    def check_aperture(self) -> None:
        """The clear aperture ends where the sag does: (1+k)·c²·r² ≤ 1."""
        c = float(self.curvature.detach())
        conic = getattr(self, "conic", None)
        alpha = (1.0 + (0.0 if conic is None else float(conic.detach()))) * c * c
        if alpha * self.semi_diameter**2 > 1.0:
            raise InputError(
                f"semi_diameter {self.semi_diameter:g} mm exceeds the surface, which ends at "
                f"{1.0 / math.sqrt(alpha):g} mm (radius {1.0 / c:g} mm)"
            )

    @staticmethod
    def conic_constant(p: Parameters) -> Tensor | float:
        """The conic constant k."""
        return p["conic"]

    @classmethod
    def sag_and_gradient(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Sag (S1) and slopes (S4): ∂s/∂x = 2x·ds/d(r²)."""
        sag, slope, inside = conic_sag(p["curvature"], cls.conic_constant(p), x * x + y * y)
        return sag, 2.0 * x * slope, 2.0 * y * slope, inside

    @classmethod
    def intersect(cls, p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
        """Closed form; the normal is (-cx, -cy, 1 - (1+k)cz) over its length."""
        c, k = p["curvature"], cls.conic_constant(p)
        t, _, met = conic_distance(c, k, ray, sense)
        nx = -c * (ray.x + ray.l * t)
        ny = -c * (ray.y + ray.m * t)
        nz = 1.0 - (1.0 + k) * c * (ray.n * t)
        inverse = torch.rsqrt(nx * nx + ny * ny + nz * nz)
        return Hit(t, nx * inverse, ny * inverse, nz * inverse, met & (nz > 0.0))

    @staticmethod
    def paraxial_curvature(p: Parameters) -> Tensor:
        """The curvature c."""
        return p["curvature"]


class Sphere(Conic):
    """A sphere of curvature c = 1/R (1/mm); c = 0 is a plane whose curvature can move."""

    kind = "sphere"

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """The curvature."""
        return ["curvature"]

    @staticmethod
    def conic_constant(p: Parameters) -> Tensor | float:
        """Zero."""
        return 0.0

    @classmethod
    def intersect(cls, p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
        """Closed form; (-cx, -cy, 1 - cz) is a unit vector on the sphere as it stands."""
        c = p["curvature"]
        t, _, met = conic_distance(c, 0.0, ray, sense)
        nz = 1.0 - c * (ray.n * t)
        return Hit(t, -c * (ray.x + ray.l * t), -c * (ray.y + ray.m * t), nz, met & (nz > 0.0))
