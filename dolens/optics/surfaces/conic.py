"""Rays meet spheres and conics in closed form."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.conic import conic_distance, conic_gradient, quadratic_root
from dolens.kernels.operations import Number, divide, safe_sqrt
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.kernels.table import TINY, Kind
from dolens.optics.rays import Components
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.surfaces.registry import register_surface


def conic_sag(c: Number, k: Number, r2: Number) -> tuple[Number, Number, Number]:
    """Return the sag of a conic, s = c·r²/(1 + R) with R = √(1 - (1+k)c²r²).

    Args:
        c: curvature, 1/mm.
        k: conic constant.
        r2: x² + y², mm².

    Returns:
        sag (mm), ds/d(r²) = c/2R (1/mm), and R² as a margin that is positive where the branch
        exists.
    """
    squared = 1.0 - ((1.0 + k) * c * c) * r2
    root = safe_sqrt(squared)
    return divide(c * r2, 1.0 + root), divide(0.5 * c, root), squared


def conic_slopes(c: Number, k: Number, r2: Number) -> tuple[Number, Number]:
    """Return ds/d(r²) of a conic (1/mm), and the second derivative in r² (1/mm³)."""
    ec2 = (1.0 + k) * c * c
    root = safe_sqrt(1.0 - ec2 * r2)
    slope = divide(0.5 * c, root)
    return slope, divide(0.5 * slope * ec2, root * root)


def conic_cotangents(
    c: Number, k: Number, r2: Number, of_sag: Number, of_slope: Number
) -> tuple[Number, Number]:
    """Return the cotangents of c and k from those of a conic's sag and of ds/d(r²).

    s_c = (r² + (1+k)s²)/2R and s_k = c·s²/2R; of c/2R: 1/2R³ and c³r²/4R³.
    """
    e = 1.0 + k
    root = safe_sqrt(1.0 - e * c * c * r2)
    inverse = divide(1.0, root)
    sag = divide(c * r2, 1.0 + root)
    cubed = 0.5 * of_slope * inverse * inverse * inverse
    return (
        0.5 * of_sag * inverse * (r2 + e * sag * sag) + cubed,
        0.5 * c * (of_sag * inverse * sag * sag + c * c * r2 * cubed),
    )


def distance_to_conic(
    c: Tensor, k: Tensor | float, ray: PlaneRay, sense: float
) -> tuple[Tensor, Tensor]:
    """Return the distance (mm) from the vertex plane to a conic, and a margin; see
    `dolens.kernels.conic`.
    """
    t, met = conic_distance(c, c + (c * k) * (ray.n * ray.n), *ray, sense)
    return t, met.detach()


def start_on_conic(p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
    """Return the distance (mm) to a surface's conic, or zero where that is out of reach."""
    t, met = distance_to_conic(p["curvature"], p["conic"], ray, sense)
    return torch.where(met > 0.0, t, torch.zeros_like(t))


def check_reach(surface: Surface) -> None:
    """Raise `InputError` where an aperture reaches beyond its surface's conic, (1+k)·c²·r² > 1."""
    curvature = surface.get_parameter("curvature")
    c = float(curvature.detach())
    conic = getattr(surface, "conic", None)
    alpha = (1.0 + (0.0 if conic is None else float(conic.detach()))) * c * c
    # A whole hemisphere is allowed, and 1/R has rounded.
    rounding = 4.0 * torch.finfo(curvature.dtype).eps
    if alpha * (surface.semi_diameter * surface.semi_diameter) > 1.0 + rounding:
        raise InputError(
            f"semi_diameter {surface.semi_diameter:g} mm exceeds the surface, which ends at "
            f"{1.0 / math.sqrt(alpha):g} mm from the axis (radius {1.0 / c:g} mm)"
        )


@register_surface
class Conic(Surface):
    """The surface is a conic of revolution with curvature c (1/mm) and conic constant k (S1 without
    a_2i).
    """

    kind = "conic"
    kernel = SurfaceKernel(kind=Kind.CONIC)
    rotational = True
    closed_form = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return curvature and conic constant."""
        return ["curvature", "conic"]

    def check_aperture(self) -> None:
        """Check that the clear aperture ends where the sag does: (1+k)·c²·r² ≤ 1."""
        check_reach(self)

    @property
    def reach(self) -> float:
        """Return 1/√((1+k)c²), mm; `inf` of a plane, a paraboloid and a hyperboloid."""
        stored = {
            name: float(value.detach()) for name, value in self.named_parameters(recurse=False)
        }
        c = stored["curvature"]
        alpha = (1.0 + stored.get("conic", 0.0)) * c * c
        return 1.0 / math.sqrt(alpha) if alpha > 0.0 else math.inf

    @classmethod
    def conic_constant(cls, p: Parameters) -> Tensor | float:
        """Return the conic constant k."""
        return p["conic"]

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag (S1) and slopes (S4): ∂s/∂x = 2x·ds/d(r²)."""
        sag, slope, exists = conic_sag(p["curvature"], cls.conic_constant(p), x * x + y * y)
        return sag, 2.0 * x * slope, 2.0 * y * slope, exists.detach()

    @classmethod
    def intersect(
        cls, p: Parameters, ray: PlaneRay, sense: float, scale: float
    ) -> tuple[Tensor, Tensor | None]:
        """Find the ray intercept in closed form, on the sag branch where 1 - (1+k)·c·z > 0."""
        c, k = p["curvature"], p["conic"]
        t, met = distance_to_conic(c, k, ray, sense)
        branch = 1.0 - ((1.0 + k) * c).detach() * (ray.n * t).detach()
        return t, torch.minimum(met, branch)

    @classmethod
    def intersect_from(
        cls, p: Parameters, ray: Components, sense: float
    ) -> tuple[Tensor, Tensor] | None:
        """Find the ray intercept in closed form from any point (x, y, z): in the quadratic equation
        of `conic_distance` F = c(x² + y² + (1+k)z²) - 2z and G = n - c(lx + my + (1+k)nz).

        A shape that adds terms to the conic is met from the vertex plane only.
        """
        if not cls.closed_form:
            return None
        c, k = p["curvature"], cls.conic_constant(p)
        x, y, z, l, m, n = ray  # noqa: E741
        f = c * (x * x + y * y + (1.0 + k) * (z * z)) - 2.0 * z
        g = n - c * (l * x + m * y + (1.0 + k) * (n * z))
        t, met = quadratic_root(f, g, c * (1.0 + k * (n * n)), sense)
        branch = 1.0 - ((1.0 + k) * c * (z + n * t)).detach()
        return t, torch.minimum(met.detach(), branch)

    @classmethod
    def normal(
        cls, p: Parameters, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return (-cx, -cy, 1 - (1+k)cz) over its length."""
        c, k = p["curvature"], p["conic"]
        nx, ny, nz = conic_gradient(c, k, x, y, z)
        squared = torch.addcmul(torch.addcmul(nx * nx, ny, ny), nz, nz)
        inverse = torch.rsqrt(squared.clamp(min=TINY))
        return nx * inverse, ny * inverse, nz * inverse

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return c, k."""
        return PackedShape((p["curvature"], p["conic"]))

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return the curvature c."""
        return p["curvature"]

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return k·c³/8."""
        return cls.conic_constant(p) * p["curvature"] ** 3 / 8.0


@register_surface
class Sphere(Conic):
    """The surface is a sphere of curvature c = 1/R (1/mm); c = 0 is a plane whose curvature can
    move.
    """

    kind = "sphere"
    kernel = SurfaceKernel(kind=Kind.SPHERE)
    rotational = True
    closed_form = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the curvature."""
        return ["curvature"]

    @classmethod
    def conic_constant(cls, p: Parameters) -> Tensor | float:
        """Return zero."""
        return 0.0

    @classmethod
    def intersect(
        cls, p: Parameters, ray: PlaneRay, sense: float, scale: float
    ) -> tuple[Tensor, Tensor | None]:
        """Find the ray intercept in closed form, on the near half where 1 - c·z > 0."""
        c = p["curvature"]
        t, met = conic_distance(c, c, *ray, sense)
        return t, torch.minimum(met.detach(), 1.0 - c.detach() * (ray.n * t).detach())

    @classmethod
    def normal(
        cls, p: Parameters, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return (-cx, -cy, 1 - cz), a unit vector on the sphere."""
        return conic_gradient(p["curvature"], 0.0, x, y, z)

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return c."""
        return PackedShape((p["curvature"],))
