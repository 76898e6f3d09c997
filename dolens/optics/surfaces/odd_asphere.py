"""An odd asphere is a conic plus all powers of r."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.kernels.operations import (
    Number,
    divide,
    fma,
    horner,
    horner_second,
    length,
    put,
    put_powers,
    sqrt,
    where,
)
from dolens.kernels.shapes import Shape
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import Parameters
from dolens.optics.surfaces.even_asphere import (
    EVEN_ASPHERE,
    AsphereWithTerms,
    EvenAsphere,
    even_asphere,
    even_asphere_hessian,
    even_asphere_parameters,
    even_asphere_sag,
    power_of,
)
from dolens.optics.surfaces.registry import register_surface

# mm²: closer to the axis than its root a point counts as the vertex.
VERTEX = 1e-30


def _radius(q: Number) -> tuple[Number, Number]:
    """Return r and 1/r, both zero at the vertex."""
    away = q > VERTEX
    # Where the root's argument is not used it is one: its derivative stays finite.
    root = sqrt(where(away, q, 1.0))
    return where(away, root, 0.0), where(away, divide(1.0, root), 0.0)


def odd_asphere_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag and slopes, and the margin of the conic's branch.

    The even asphere has r·(a1 + q·H) beside it, with q = r² and H = a3 + a5·q + ..., whose slope
    along r over r is a1/r + r·(3H + 2q·H').
    """
    c, k, a2, even, a1, odd = p
    sag, sx, sy, margin = even_asphere_sag((c, k, a2, even), x, y)
    q = fma(x, x, y * y)
    h, d = horner(odd, q)
    r, inverse = _radius(q)
    slope = fma(r, fma(q, 2.0 * d, 3.0 * h), a1 * inverse)
    return fma(r, fma(q, h, a1), sag), fma(x, slope, sx), fma(y, slope, sy), margin


def odd_asphere_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives.

    With P(r) and g = P'/r: s_xx = g + (x/r)²·(P'' - g), and P'' - g has no cancellation: -a1/r +
    r·(3H + 12q·H' + 4q²·H'').
    """
    c, k, a2, even, a1, odd = p
    sx, sy, sxx, sxy, syy = even_asphere_hessian((c, k, a2, even), x, y)
    q = fma(x, x, y * y)
    h, d, e = horner_second(odd, q)
    r, inverse = _radius(q)
    slope = a1 * inverse + r * (3.0 * h + 2.0 * q * d)
    more = r * (3.0 * h + q * (12.0 * d + 8.0 * q * e)) - a1 * inverse
    u, v = x * inverse, y * inverse
    return (
        sx + x * slope,
        sy + y * slope,
        sxx + slope + u * u * more,
        sxy + u * v * more,
        syy + slope + v * v * more,
    )


def odd_asphere_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of the even asphere's numbers, of a1 and of the coefficients of H."""
    c, k, a2, even, _, odd = p
    even_asphere_parameters(cotangents, (c, k, a2, even), x, y, of_sag, of_x, of_y)
    q = fma(x, x, y * y)
    r, inverse = _radius(q)
    of_slope = (of_x * x + of_y * y) * inverse
    place = 3 + length(even)
    put(cotangents, place, of_sag * r + of_slope)
    put_powers(cotangents, place + 1, length(odd), r, q, of_sag, of_slope * r, 3, 2)


ODD_ASPHERE = Shape(
    "odd_asphere",
    odd_asphere_sag,
    odd_asphere_hessian,
    odd_asphere_parameters,
    layout=(*EVEN_ASPHERE.layout, None, Code.COLUMNS),
    starts_on_conic=True,
)


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
    shape = ODD_ASPHERE
    rotational = True

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the odd coefficients that the prescription names, by rising powers."""
        powers = sorted(power for key in keys if (power := power_of(str(key))) and power % 2)
        return [f"a{power}" for power in powers]

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return the even asphere's numbers, a1, and a3, a5, ... up to the highest."""
        highest = max((power for name in p if (power := power_of(name)) and power % 2), default=1)
        odd = tuple(p.get(f"a{power}", 0.0) for power in range(3, highest + 1, 2))
        return *EvenAsphere.numbers(p), p.get("a1", 0.0), odd

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
