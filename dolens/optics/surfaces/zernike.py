"""Zernike polynomials, by Noll's and by fringe numbers, and surfaces that add them to a conic.

Jacobi polynomials P_k^(0, m)(2q - 1) on 0 ≤ q ≤ 1, by their three-term recurrence.

They are the radial part of Zernike's polynomials, R_n^m(ρ) = ρ^m·P_k^(0, m)(2ρ² - 1) with
k = (n - m)/2, and with m = 4 Forbes's Q_con.  Recurrence keeps them accurate to any order, where
powers of q with their alternating coefficients would lose all digits.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.even_asphere import AsphereWithTerms
from dolens.optics.surfaces.registry import order_of, order_pattern, register_surface

FRINGE_TERMS = 37


class ZernikeTerm(NamedTuple):
    """The term is norm · R_n^m(ρ) · cos(mφ), or sin(mφ).

    Attributes:
        n: radial order.
        m: azimuthal order, not negative.
        sine: sin(mφ) instead of cos(mφ).
        norm: factor of the polynomial.
    """

    n: int
    m: int
    sine: bool
    norm: float


@cache
def noll(number: int) -> ZernikeTerm:
    """Return a term in Noll's order, of unit variance over the unit disc.

    Even numbers are cosines, odd ones sines; the norm is √(n+1), times √2 for m > 0.
    Source: Noll, Zernike polynomials and atmospheric turbulence, J. Opt. Soc. Am. 66, 207 (1976).
    Zemax calls this order and norm "Zernike Standard".
    """
    n = 0
    while (n + 1) * (n + 2) // 2 < number:
        n += 1
    place = number - n * (n + 1) // 2  # from 1 within this radial order
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return ZernikeTerm(n, m, m > 0 and number % 2 == 1, math.sqrt((n + 1) * (2 if m else 1)))


@cache
def fringe(number: int) -> ZernikeTerm:
    """Return a term in the University of Arizona's order, of value 1 at the edge on its axis.

    Groups have equal n + m; within one m falls from n to 0, the cosine before the sine.  The last
    of the 37 terms is that of ρ¹² alone, out of this order.
    """
    if number == FRINGE_TERMS:
        return ZernikeTerm(12, 0, False, 1.0)
    group = math.isqrt(number - 1)  # (n + m)/2
    place = number - group * group - 1  # from 0 within the group
    m = group - place // 2
    return ZernikeTerm(2 * group - m, m, m > 0 and place % 2 == 1, 1.0)


_TERM = order_pattern("z")
_KERNELS = ("dolens.kernels.cpu.zernike", "dolens.kernels.cuda.zernike")


class ZernikeSag(AsphereWithTerms):
    """The sag is that of an even asphere plus Σ z_j·Z_j(ρ, φ), coefficients in mm.

    ρ·cos φ = (x - decenter_x)/normalization_radius and ρ·sin φ = (y - decenter_y)/
    normalization_radius: φ is measured from +x towards +y.  The decentre moves the polynomials
    alone.  They are no more than polynomials, so they go on beyond the normalisation radius, and
    the clear aperture may exceed it.
    """

    constants = ("normalization_radius", "decenter_x", "decenter_y")
    terms: ClassVar[int]
    term: ClassVar[Callable[[int], ZernikeTerm]]

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        given = dict.fromkeys(("decenter_x", "decenter_y"), 0.0) | dict(parameters)
        require_normalization_radius(given)
        super().__init__(aperture, given, dtype)

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the coefficients that the prescription names, by rising numbers, and constants."""
        numbers = sorted(order for key in keys if (order := order_of(_TERM, key)) is not None)
        if numbers and numbers[-1] > cls.terms:
            raise InputError(f"'z{numbers[-1]}': {cls.kind} has z1 to z{cls.terms}")
        return [*(f"z{number}" for number in numbers), *cls.constants]

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return Σ z_j·Z_j and its slopes, azimuthal order by order.

        ρ^m·cos(mφ) and ρ^m·sin(mφ) are Re w^m and Im w^m with w = u + i·v: polynomials, with no
        angle and no division at the centre.
        """
        scale = 1.0 / p["normalization_radius"]
        u, v = (x - p["decenter_x"]) * scale, (y - p["decenter_y"]) * scale
        q = torch.addcmul(u * u, v, v)
        zero = torch.zeros_like(q)
        sag, su, sv = zero, zero, zero
        cosine, sine, cosine_below, sine_below = torch.ones_like(q), zero, zero, zero
        groups = cls._groups(p)
        for m in range(max(groups, default=-1) + 1):
            group = groups.get(m, {})
            # Cosines times a, sines times b, and their derivatives in q.
            a, da, b, db = zero, zero, zero, zero
            for k, (value, slope) in enumerate(jacobi(q, m, max(group, default=-1) + 1)):
                for name, is_sine, norm in group.get(k, ()):
                    coefficient = norm * p[name]
                    if is_sine:
                        b, db = b + coefficient * value, db + coefficient * slope
                    else:
                        a, da = a + coefficient * value, da + coefficient * slope
            if group:
                sag = sag + cosine * a + sine * b
                radial = 2.0 * (cosine * da + sine * db)
                su = su + m * (cosine_below * a + sine_below * b) + u * radial
                sv = sv + m * (cosine_below * b - sine_below * a) + v * radial
            cosine, sine, cosine_below, sine_below = (
                cosine * u - sine * v,
                sine * u + cosine * v,
                cosine,
                sine,
            )
        return sag, su * scale, sv * scale

    @classmethod
    def added_numbers(cls, p: Parameters) -> PackedShape:
        """Return the constants and then the coefficients; columns: how many; degree: highest m.

        Extras: whether terms are normalised; then for each m from 0 the number of radial orders,
        and for each of these the place of the cosine's and of the sine's coefficient, or -1.
        """
        groups = cls._groups(p)
        names = [name for name in p if _TERM.fullmatch(name)]
        extras = [int(cls.term is noll)]
        highest = max(groups, default=0)
        for m in range(highest + 1):
            group = groups.get(m, {})
            extras.append(max(group, default=-1) + 1)
            for k in range(extras[-1]):
                places = [-1, -1]
                for name, is_sine, _ in group.get(k, ()):
                    places[is_sine] = names.index(name)
                extras += places
        numbers = (*(p[name] for name in cls.constants), *(p[name] for name in names))
        return PackedShape(numbers, columns=len(names), degree=highest, extras=tuple(extras))

    @classmethod
    def _groups(cls, p: Parameters) -> dict[int, dict[int, list[tuple[str, bool, float]]]]:
        """Return azimuthal order → k = (n - m)/2 → names of coefficients, whether sine, norms."""
        groups: dict[int, dict[int, list[tuple[str, bool, float]]]] = {}
        for name in p:
            if _TERM.fullmatch(name):
                n, m, sine, norm = cls.term(int(name[1:]))
                groups.setdefault(m, {}).setdefault((n - m) // 2, []).append((name, sine, norm))
        return groups


def require_normalization_radius(given: Mapping[str, Any]) -> None:
    """Raise `InputError` where the normalisation radius is missing or not positive."""
    radius = given.get("normalization_radius", 0.0)
    if not float(radius) > 0.0:
        raise InputError(f"'normalization_radius' must be given and positive (mm), not {radius}")


@register_surface
class ZernikeStandard(ZernikeSag):
    """The polynomials are in Noll's order with unit variance over the disc ("standard")."""

    kind = "zernike_standard"
    kernel = SurfaceKernel(*_KERNELS)
    terms = 231
    term = staticmethod(noll)


@register_surface
class ZernikeFringe(ZernikeSag):
    """The polynomials are in the University of Arizona's order, 1 at the disc's edge ("fringe")."""

    kind = "zernike_fringe"
    kernel = SurfaceKernel(*_KERNELS)
    terms = FRINGE_TERMS
    term = staticmethod(fringe)


@cache
def recurrence(k: int, m: int) -> tuple[float, float, float]:
    """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2), for k ≥ 1.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 22.7.1, at x = 2q - 1.
    """
    if k == 1:
        return m + 2.0, -(m + 1.0), 0.0
    lower, here, both = 2 * k + m - 2, 2 * k + m - 1, 2 * k + m
    scale = 2 * k * (k + m) * lower
    slope = here * both * lower / scale
    return 2.0 * slope, -here * m * m / scale - slope, 2 * (k - 1) * (k + m - 1) * both / scale


def jacobi(q: Tensor, m: int, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield P_k^(0, m)(2q - 1) and its derivative in q, for k = 0, 1, ..., count - 1."""
    value, slope = torch.ones_like(q), torch.zeros_like(q)
    lower, lower_slope = torch.zeros_like(q), torch.zeros_like(q)
    for k in range(count):
        if k > 0:
            a, b, c = recurrence(k, m)
            factor = a * q + b
            value, lower, slope, lower_slope = (
                factor * value - c * lower,
                value,
                factor * slope + a * value - c * lower_slope,
                slope,
            )
        yield value, slope
