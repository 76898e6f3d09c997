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
from dolens.kernels.operations import (
    Number,
    divide,
    entry,
    fma,
    length,
    next_second,
    next_term,
    number,
    put,
    sqrt,
    term,
    where,
    zero,
)
from dolens.kernels.shapes import TABLE, Shape
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import Parameters
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.even_asphere import (
    EVEN_ASPHERE,
    AsphereWithTerms,
    EvenAsphere,
    even_asphere,
    even_asphere_hessian,
    even_asphere_parameters,
    even_asphere_sag,
)
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


def jacobi_step(k: Number, m: Number) -> tuple[Number, Number, Number]:
    """Return (α, β, γ) of P_k^(0, m)(2q - 1) = (α·q + β)·P_(k-1) - γ·P_(k-2), for k ≥ 1.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 22.7.1, at x = 2q - 1.
    """
    lower, here, both = 2.0 * k + m - 2.0, 2.0 * k + m - 1.0, 2.0 * k + m
    scale = 2.0 * k * (k + m)
    slope = divide(here * both, scale)
    # Where it is zero, so are the numbers over it.
    scale = scale * where(lower > 0.0, lower, 1.0)
    offset = divide(here * m * m, scale)
    return 2.0 * slope, -offset - slope, divide(2.0 * (k - 1.0) * (k + m - 1.0) * both, scale)


def terms_slopes(
    terms: Any, table: Any, u: Number, v: Number, like: Number
) -> tuple[Number, Number, Number]:
    """Return the sum of the terms at u, v, and its derivatives there.

    ρ^m·cos(mφ) and ρ^m·sin(mφ) are C = Re w^m and S = Im w^m with w = u + i·v: polynomials, with no
    angle and no division at the centre.  The derivatives of C along u and v are m·C' and -m·S' of
    w^(m-1), and those of S m·S' and m·C'.

    Args:
        terms: coefficients of cosine and sine, by turns.
        table: three integers for each term: k, m, and the square of its norm.  From k = 0 on, k
            grows for each m.
        u: x over the radius, and v.
        v: y over it.
        like: a number of the surface's.
    """
    q = fma(u, u, v * v)
    total, su, sv, radial = zero(u), zero(u), zero(u), zero(u)
    value, slope, value_below, slope_below = zero(u) + 1.0, zero(u), zero(u), zero(u)
    c, s, c1, s1 = zero(u) + 1.0, zero(u), zero(u), zero(u)
    for t in range(length(table) // 3):
        k, m = entry(table, 3 * t), number(entry(table, 3 * t + 1), like)
        if k == 0:
            value, slope, value_below, slope_below = zero(u) + 1.0, zero(u), zero(u), zero(u)
            if entry(table, 3 * t + 1) > 0:
                c1, s1 = c, s
                c, s = fma(c1, u, -s1 * v), fma(s1, u, c1 * v)
        else:
            alpha, beta, gamma = jacobi_step(number(k, like), m)
            value, slope, value_below, slope_below = next_term(
                alpha, beta, gamma, q, value, slope, value_below, slope_below
            )
        norm = sqrt(number(entry(table, 3 * t + 2), like))
        a, b = norm * term(terms, 2 * t), norm * term(terms, 2 * t + 1)
        both = fma(a, c, b * s)
        total = fma(both, value, total)
        radial = fma(both, slope, radial)
        su = fma(m * (a * c1 + b * s1), value, su)
        sv = fma(m * (b * c1 - a * s1), value, sv)
    return total, fma(2.0 * u, radial, su), fma(2.0 * v, radial, sv)


def terms_second(
    terms: Any, table: Any, u: Number, v: Number, like: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return the sum of the terms at u, v, and its first and second derivatives there.

    With E = a·C + b·S of a term, and G1 and G2 the same with w^(m-1) and w^(m-2) and their factors
    m and m(m-1): s_uu = G2·P + 4u·G1·P' + E·(2P' + 4u²·P'').
    """
    q = fma(u, u, v * v)
    e0, e1, e2, g0, h0, g1, h1, g2, h2 = (
        zero(u), zero(u), zero(u), zero(u), zero(u), zero(u), zero(u), zero(u), zero(u)
    )  # fmt: skip
    value, slope, second = zero(u) + 1.0, zero(u), zero(u)
    value_below, slope_below, second_below = zero(u), zero(u), zero(u)
    c, s, c1, s1, c2, s2 = zero(u) + 1.0, zero(u), zero(u), zero(u), zero(u), zero(u)
    for t in range(length(table) // 3):
        k, m = entry(table, 3 * t), number(entry(table, 3 * t + 1), like)
        if k == 0:
            value, slope, second = zero(u) + 1.0, zero(u), zero(u)
            value_below, slope_below, second_below = zero(u), zero(u), zero(u)
            if entry(table, 3 * t + 1) > 0:
                c2, s2, c1, s1 = c1, s1, c, s
                c, s = fma(c1, u, -s1 * v), fma(s1, u, c1 * v)
        else:
            alpha, beta, gamma = jacobi_step(number(k, like), m)
            second, second_below = next_second(alpha, beta, gamma, q, slope, second, second_below)
            value, slope, value_below, slope_below = next_term(
                alpha, beta, gamma, q, value, slope, value_below, slope_below
            )
        norm = sqrt(number(entry(table, 3 * t + 2), like))
        a, b = norm * term(terms, 2 * t), norm * term(terms, 2 * t + 1)
        both, along, across = fma(a, c, b * s), m * (a * c1 + b * s1), m * (b * c1 - a * s1)
        pairs = m * (m - 1.0)
        e0, e1, e2 = fma(both, value, e0), fma(both, slope, e1), fma(both, second, e2)
        g0, h0 = fma(along, value, g0), fma(across, value, h0)
        g1, h1 = fma(along, slope, g1), fma(across, slope, h1)
        g2 = fma(pairs * (a * c2 + b * s2), value, g2)
        h2 = fma(pairs * (b * c2 - a * s2), value, h2)
    e1, e2, g1, h1 = 2.0 * e1, 4.0 * e2, 2.0 * g1, 2.0 * h1
    return (
        e0,
        g0 + u * e1,
        h0 + v * e1,
        g2 + 2.0 * u * g1 + e1 + u * u * e2,
        h2 + u * h1 + v * g1 + u * v * e2,
        e1 - g2 + 2.0 * v * h1 + v * v * e2,
    )


def put_terms(
    cotangents: Any, place: int, table: Any, u: Number, v: Number, like: Number,
    of_sum: Number, of_u: Number, of_v: Number,
) -> None:  # fmt: skip
    """Set the cotangents of the coefficients, from `place` on, from those of the sum and its
    derivatives along u and v.

    Of a: of_sum·C·P + of_u·(m·C'·P + 2u·C·P') + of_v·(-m·S'·P + 2v·C·P').
    """
    q = fma(u, u, v * v)
    of_slope = 2.0 * (of_u * u + of_v * v)
    value, slope, value_below, slope_below = zero(u) + 1.0, zero(u), zero(u), zero(u)
    c, s, c1, s1 = zero(u) + 1.0, zero(u), zero(u), zero(u)
    for t in range(length(table) // 3):
        k, m = entry(table, 3 * t), number(entry(table, 3 * t + 1), like)
        if k == 0:
            value, slope, value_below, slope_below = zero(u) + 1.0, zero(u), zero(u), zero(u)
            if entry(table, 3 * t + 1) > 0:
                c1, s1 = c, s
                c, s = fma(c1, u, -s1 * v), fma(s1, u, c1 * v)
        else:
            alpha, beta, gamma = jacobi_step(number(k, like), m)
            value, slope, value_below, slope_below = next_term(
                alpha, beta, gamma, q, value, slope, value_below, slope_below
            )
        norm = sqrt(number(entry(table, 3 * t + 2), like))
        of_value, of_derivative = norm * value, norm * slope * of_slope
        of_c = of_sum * c + m * (of_u * c1 - of_v * s1)
        of_s = of_sum * s + m * (of_u * s1 + of_v * c1)
        put(cotangents, place + 2 * t, of_c * of_value + c * of_derivative)
        put(cotangents, place + 1 + 2 * t, of_s * of_value + s * of_derivative)


def terms_of(
    found: Mapping[tuple[int, int, bool], Any], normalised: bool
) -> tuple[tuple[Any, ...], tuple[int, ...]]:
    """Return coefficients of cosine and sine term by term, 0.0 between them, and the table of the
    terms: of each m all k up to the highest.

    Args:
        found: coefficients by k, m, and whether of the sine.
        normalised: whether terms have unit variance.
    """
    highest = [0] * (1 + max((m for _, m, _ in found), default=0))
    for k, m, _ in found:
        highest[m] = max(highest[m], k)
    terms = [(k, m) for m, most in enumerate(highest) for k in range(most + 1)]
    coefficients = (found.get((k, m, sine), 0.0) for k, m in terms for sine in (False, True))
    norms = [(2 * k + m + 1) * (2 if m else 1) if normalised else 1 for k, m in terms]
    table = ((k, m, norm) for (k, m), norm in zip(terms, norms, strict=True))
    return tuple(coefficients), tuple(n for row in table for n in row)


def zernike_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag and slopes, and the margin of the conic's branch."""
    curvature, conic, a2, even, radius, decenter_x, decenter_y, terms, table = p
    sag, sx, sy, margin = even_asphere_sag((curvature, conic, a2, even), x, y)
    scale = divide(1.0, radius)
    u, v = (x - decenter_x) * scale, (y - decenter_y) * scale
    added, su, sv = terms_slopes(terms, table, u, v, radius)
    return sag + added, fma(su, scale, sx), fma(sv, scale, sy), margin


def zernike_hessian(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives."""
    curvature, conic, a2, even, radius, decenter_x, decenter_y, terms, table = p
    sx, sy, sxx, sxy, syy = even_asphere_hessian((curvature, conic, a2, even), x, y)
    scale = divide(1.0, radius)
    u, v = (x - decenter_x) * scale, (y - decenter_y) * scale
    _, su, sv, suu, suv, svv = terms_second(terms, table, u, v, radius)
    squared = scale * scale
    return (
        fma(su, scale, sx),
        fma(sv, scale, sy),
        fma(suu, squared, sxx),
        fma(suv, squared, sxy),
        fma(svv, squared, syy),
    )


def zernike_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of the even asphere's numbers and of the coefficients; the normalisation
    radius and the decentre are data.
    """
    curvature, conic, a2, even, radius, decenter_x, decenter_y, _, table = p
    even_asphere_parameters(cotangents, (curvature, conic, a2, even), x, y, of_sag, of_x, of_y)
    place = 3 + length(even)
    put(cotangents, place, zero(x))
    put(cotangents, place + 1, zero(x))
    put(cotangents, place + 2, zero(x))
    scale = divide(1.0, radius)
    u, v = (x - decenter_x) * scale, (y - decenter_y) * scale
    put_terms(cotangents, place + 3, table, u, v, radius, of_sag, of_x * scale, of_y * scale)


ZERNIKE = Shape(
    "zernike",
    zernike_sag,
    zernike_hessian,
    zernike_parameters,
    layout=(*EVEN_ASPHERE.layout, None, None, None, Code.COLUMNS, TABLE),
    starts_on_conic=True,
)
_KERNEL = SurfaceKernel(shape=ZERNIKE)


class ZernikeSag(AsphereWithTerms):
    """The sag is that of an even asphere plus Σ z_j·Z_j(ρ, φ), coefficients in mm.

    ρ·cos φ = (x - decenter_x)/normalization_radius and ρ·sin φ = (y - decenter_y)/
    normalization_radius: φ is measured from +x towards +y.  The decentre moves the polynomials
    alone.  They are no more than polynomials, so they go on beyond the normalisation radius, and
    the clear aperture may exceed it.
    """

    shape = ZERNIKE
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
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return the even asphere's numbers, the constants, the coefficients and their table."""
        found = {}
        for name in filter(_TERM.fullmatch, p):
            n, m, sine, _ = cls.term(int(name[1:]))
            found[(n - m) // 2, m, sine] = p[name]
        constants = (p[name] for name in cls.constants)
        return *EvenAsphere.numbers(even_asphere(p)), *constants, *terms_of(found, cls.term is noll)


def require_normalization_radius(given: Mapping[str, Any]) -> None:
    """Raise `InputError` where the normalisation radius is missing or not positive."""
    radius = given.get("normalization_radius", 0.0)
    if not float(radius) > 0.0:
        raise InputError(f"'normalization_radius' must be given and positive (mm), not {radius}")


@register_surface
class ZernikeStandard(ZernikeSag):
    """The polynomials are in Noll's order with unit variance over the disc ("standard")."""

    kind = "zernike_standard"
    kernel = _KERNEL
    terms = 231
    term = staticmethod(noll)


@register_surface
class ZernikeFringe(ZernikeSag):
    """The polynomials are in the University of Arizona's order, 1 at the disc's edge ("fringe")."""

    kind = "zernike_fringe"
    kernel = _KERNEL
    terms = FRINGE_TERMS
    term = staticmethod(fringe)


def jacobi(q: Tensor, m: int, count: int) -> Iterator[Tensor]:
    """Yield P_k^(0, m)(2q - 1) for k = 0, 1, ..., count - 1."""
    value, below = torch.ones_like(q), torch.zeros_like(q)
    for k in range(count):
        if k > 0:
            alpha, beta, gamma = jacobi_step(float(k), float(m))
            value, below = (alpha * q + beta) * value - gamma * below, value
        yield value
