"""An even asphere is a conic plus powers of r² (S1, S2); other shapes add further terms to it."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operations import (
    Number,
    by_radius,
    divide,
    fma,
    horner,
    horner_second,
    length,
    put,
    put_powers,
    safe_sqrt,
)
from dolens.kernels.shapes import Shape
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
from dolens.optics.surfaces.conic import (
    Conic,
    check_reach,
    conic_cotangents,
    conic_slopes,
    start_on_conic,
)
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.surfaces.registry import order_of, order_pattern, register_surface

_POWER = order_pattern("a")


def power_of(name: str) -> int | None:
    """Return the power of r whose coefficient has this name: 4 for `a4`; None for another name."""
    return order_of(_POWER, name)


def even_power(name: str) -> int | None:
    """Return the power of r whose coefficient has this name, where it is even; else None."""
    power = power_of(name)
    return None if power is None or power % 2 else power


def even_asphere_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag and slopes, and the margin of the conic's branch.

    With q = r² and H = a4 + a6·q + ...: s = conic + a2·q + q²·H.
    """
    c, k, a2, a = p
    q = fma(x, x, y * y)
    h, d = horner(a, q)
    squared = 1.0 - ((1.0 + k) * c * c) * q
    root = safe_sqrt(squared)
    beyond = 1.0 + root
    both = divide(c, root * beyond)
    twice = fma(both, beyond, 2.0 * fma(q, fma(q, d, 2.0 * h), a2))
    return q * fma(both, root, fma(q, h, a2)), x * twice, y * twice, squared


def even_asphere_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives."""
    c, k, a2, a = p
    q = fma(x, x, y * y)
    h, d, e = horner_second(a, q)
    slope, second = conic_slopes(c, k, q)
    slope = slope + a2 + q * (2.0 * h + q * d)
    return by_radius(x, y, slope, second + 2.0 * h + 4.0 * q * d + 2.0 * q * q * e)


def even_asphere_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of c, k, a2 and the further coefficients."""
    c, k, _, a = p
    q = fma(x, x, y * y)
    of_slope = 2.0 * (of_x * x + of_y * y)
    of_c, of_k = conic_cotangents(c, k, q, of_sag, of_slope)
    put(cotangents, 0, of_c)
    put(cotangents, 1, of_k)
    put(cotangents, 2, of_sag * q + of_slope)
    put_powers(cotangents, 3, length(a), q, q, of_sag, of_slope, 2, 1)


EVEN_ASPHERE = Shape(
    "even_asphere",
    even_asphere_sag,
    even_asphere_hessian,
    even_asphere_parameters,
    layout=(None, None, None, Code.COUNT),
    starts_on_conic=True,
)


@register_surface
class EvenAsphere(Conic):
    """The sag is s(r) = conic + a2·r² + a4·r⁴ + a6·r⁶ + ..., coefficients in mm^(1 - power).

    The curvature at the vertex is c + 2·a2.  Beside a free curvature and conic constant a2 is
    nearly redundant; it is here for prescriptions that have it.
    """

    kind = "even_asphere"
    shape = EVEN_ASPHERE
    rotational = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return curvature, conic constant and the coefficients that the prescription names."""
        powers = []
        for key in keys:
            power = power_of(str(key))
            if power is None:
                continue
            if power % 2:
                raise InputError(f"'{key}': even aspheric coefficients are a2, a4, a6, a8, ...")
            powers.append(power)
        return ["curvature", "conic", *(f"a{power}" for power in sorted(powers))]

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return c, k, a2, and a4, a6, ... up to the highest."""
        highest = max((power for name in p if (power := even_power(name))), default=2)
        further = tuple(p.get(f"a{power}", 0.0) for power in range(4, highest + 1, 2))
        return p["curvature"], p["conic"], p.get("a2", 0.0), further

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag (S1) and slopes (S4), the polynomial by Horner's rule in r²."""
        return super(Conic, cls).sag_and_gradient(p, x, y)

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return c, k, a2, and a4, a6, ...: all powers up to the highest, in groups of four."""
        return super(Conic, cls).packed(p)

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return c + 2·a2."""
        return p["curvature"] + 2.0 * p["a2"] if "a2" in p else p["curvature"]

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return k·c³/8 + a4, and (c³ - (c + 2·a2)³)/8 where there is an a2."""
        departure = super().fourth_order_departure(p) + p.get("a4", 0.0)
        if "a2" not in p:
            return departure
        return departure + (p["curvature"] ** 3 - cls.paraxial_curvature(p) ** 3) / 8.0

    @classmethod
    def start(cls, p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """Return the conic's own intersection, or the vertex plane where that is out of reach."""
        return start_on_conic(p, ray, sense)

    @classmethod
    def intersect(
        cls, p: Parameters, ray: PlaneRay, sense: float, scale: float
    ) -> tuple[Tensor, Tensor | None]:
        """Find the ray intercept by Newton's iteration from the conic."""
        return super(Conic, cls).intersect(p, ray, sense, scale)

    @classmethod
    def normal(
        cls, p: Parameters, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the unit normal from the slopes."""
        return super(Conic, cls).normal(p, x, y, z)


class AsphereWithTerms(Surface):
    """The sag is that of an even asphere plus further terms.

    A subclass offers `added_names`, and a `shape` with the even asphere's numbers in front.
    """

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the parameters of the added terms, of a surface with these keys."""
        raise NotImplementedError

    def check_aperture(self) -> None:
        """Check that the clear aperture ends where the conic does: (1+k)·c²·r² ≤ 1."""
        check_reach(self)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return curvature, conic constant, even powers, and the added terms."""
        even = {key: value for key, value in keys.items() if even_power(str(key)) is not None}
        return [*EvenAsphere.parameter_names(even), *cls.added_names(keys)]

    @classmethod
    def start(cls, p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """Return the conic's own intersection, or the vertex plane where that is out of reach."""
        return start_on_conic(p, ray, sense)


def even_asphere(p: Parameters) -> dict[str, Tensor]:
    """Return the parameters of the even asphere among those of a surface."""
    return {
        name: value
        for name, value in p.items()
        if name in ("curvature", "conic") or even_power(name) is not None
    }
