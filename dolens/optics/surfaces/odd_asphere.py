"""An odd asphere is a conic plus all powers of r."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.even_asphere import (
    AsphereWithTerms,
    EvenAsphere,
    even_asphere,
    power_of,
)
from dolens.optics.surfaces.registry import register_surface

# mm²: closer to the axis than its root a point counts as the vertex.
VERTEX = 1e-30


@register_surface
class OddAsphere(AsphereWithTerms):
    """The sag is s(r) = conic + a1·r + a2·r² + a3·r³ + ..., coefficients in mm^(1 - power).

    With a1 the surface is the cone of an axicon near the vertex, which is a cusp: the normal there
    is taken along the axis, the mean over azimuth, and derivatives of a ray through the very
    vertex are those without a1.  A cusp has no curvature: paraxial properties of a lens with
    a1 ≠ 0 are NaN, and so is the fourth-order departure where a1 or a3 is not zero, since |r|³ has
    no fourth derivative at the vertex.
    """

    kind = "odd_asphere"
    kernel = SurfaceKernel("dolens.kernels.cpu.odd_asphere", "dolens.kernels.cuda.odd_asphere")
    rotational = True

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the odd coefficients that the prescription names, by rising powers."""
        powers = sorted(power for key in keys if (power := power_of(str(key))) and power % 2)
        return [f"a{power}" for power in powers]

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the odd powers, r·(a1 + r²·H(r²)) with H = a3 + a5·r² + ..., and their slopes.

        The slope along r over r is a1/r + r·(3H + 2r²·H').
        """
        r2 = torch.addcmul(x * x, y, y)
        away = r2 > VERTEX
        # Where the root's argument is not used it is one: its derivative stays finite.
        root = torch.sqrt(torch.where(away, r2, torch.ones_like(r2)))
        r, inverse = torch.where(away, root, 0.0), torch.where(away, 1.0 / root, 0.0)
        a1 = p.get("a1", 0.0)
        h, dh = torch.zeros_like(r2), torch.zeros_like(r2)
        highest = max((power for name in p if (power := power_of(name)) and power % 2), default=1)
        for power in range(highest, 1, -2):
            dh = torch.addcmul(h, dh, r2)
            h = h * r2 + p.get(f"a{power}", 0.0)
        slope = a1 * inverse + r * (3.0 * h + 2.0 * r2 * dh)
        return r * (a1 + r2 * h), x * slope, y * slope

    @classmethod
    def added_numbers(cls, p: Parameters) -> PackedShape:
        """Return a1, and a3, a5, ... up to the highest, in groups of four; columns: how many."""
        highest = max((power for name in p if (power := power_of(name)) and power % 2), default=1)
        count = -(-((highest - 1) // 2) // 4) * 4
        odd = (p.get(f"a{2 * i + 3}") for i in range(count))
        return PackedShape((p.get("a1"), *odd), columns=count)

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return c + 2·a2; NaN where a1 makes the vertex a cusp."""
        return EvenAsphere.paraxial_curvature(even_asphere(p)) + _undefined(p, "a1")

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return that of the even powers; NaN where a1 or a3 is not zero."""
        departure = EvenAsphere.fourth_order_departure(even_asphere(p))
        return departure + _undefined(p, "a1", "a3")


def _undefined(p: Parameters, *names: str) -> Tensor | float:
    """Return NaN where one of the coefficients is not zero, else zero."""
    total = sum((p[name].detach().abs() for name in names if name in p), 0.0)
    if not isinstance(total, Tensor):
        return 0.0
    return torch.where(total > 0.0, torch.full_like(total, math.nan), torch.zeros_like(total))
