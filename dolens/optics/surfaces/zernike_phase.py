"""Phases that are sums of Zernike polynomials: wavefront errors that were measured, or are wanted.

Zernike polynomials are polynomials in x and y: paraxial properties are those of an XY phase, whose
coefficients are sums of these ones.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, ClassVar

from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operations import Number, divide, put, zero
from dolens.kernels.shapes import TABLE, PhaseFunctions
from dolens.kernels.surface_kernel import LawKernel
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.deflection import ParaxialPower
from dolens.optics.surfaces.phase import Phase, XYPhase, register_phase
from dolens.optics.surfaces.registry import order_of, order_pattern
from dolens.optics.surfaces.zernike import (
    FRINGE_TERMS,
    ZernikeTerm,
    fringe,
    noll,
    put_terms,
    terms_of,
    terms_second,
    terms_slopes,
)

_TERM = order_pattern("z")
_RADIANS = 2.0 * math.pi


def zernike_phase(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return the phase and its gradient."""
    order, radius, terms, table = p
    inverse = divide(1.0, radius)
    value, du, dv = terms_slopes(terms, table, inverse * x, inverse * y, radius)
    scale = _RADIANS * order
    slope = scale * inverse
    return scale * value, slope * du, slope * dv


def zernike_phase_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return phase, gradient and second derivatives."""
    order, radius, terms, table = p
    inverse = divide(1.0, radius)
    value, du, dv, uu, uv, vv = terms_second(terms, table, inverse * x, inverse * y, radius)
    scale = _RADIANS * order
    slope = scale * inverse
    second = slope * inverse
    return scale * value, slope * du, slope * dv, second * uu, second * uv, second * vv


def zernike_phase_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_phase: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of the coefficients; order and radius are no variables."""
    order, radius, _, table = p
    put(cotangents, 0, zero(x))
    put(cotangents, 1, zero(x))
    inverse = divide(1.0, radius)
    scale = _RADIANS * order
    slope = scale * inverse
    put_terms(
        cotangents, 2, table, inverse * x, inverse * y, radius,
        scale * of_phase, slope * of_x, slope * of_y,
    )  # fmt: skip


ZERNIKE_PHASE = PhaseFunctions(
    "zernike_phase",
    zernike_phase,
    zernike_phase_hessian,
    zernike_phase_parameters,
    (None, None, Code.LAW_COUNT, TABLE),
)


class ZernikePhase(Phase):
    """The phase is φ = 2π·Σ z_j·(Z_j(x/R, y/R) - Z_j(0, 0)) with R = norm_radius; coefficients in
    waves.

    Polynomials go on beyond the radius.  A constant phase, which no ray sees, is left out.
    """

    kernel = LawKernel(ZERNIKE_PHASE)
    terms: ClassVar[int]
    term: ClassVar[Callable[[int], ZernikeTerm]]

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return order, radius of normalisation, and the coefficients that the prescription
        names.
        """
        numbers = sorted(order for key in keys if (order := order_of(_TERM, key)) is not None)
        if numbers and numbers[-1] > cls.terms:
            raise InputError(f"'z{numbers[-1]}': a phase of type {cls.type} has z1 to z{cls.terms}")
        return ["order", "norm_radius", *(f"z{number}" for number in numbers)]

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return order, radius of normalisation, the coefficients, and their table.

        The coefficient of the constant makes the phase zero in the middle, where P_k = (-1)^k.
        """
        found: dict[tuple[int, int, bool], Any] = {}
        middle: Any = 0.0
        for name, value in p.items():
            match = _TERM.fullmatch(name)
            if match is None:
                continue
            n, m, sine, norm = cls.term(int(match[1]))
            found[(n - m) // 2, m, sine] = value
            if m == 0 and n > 0:
                middle = middle + (-1.0) ** (n // 2) * norm * value
        found[0, 0, False] = -1.0 * middle
        return p["order"], p["norm_radius"], *terms_of(found, cls.term is noll)

    @classmethod
    def packed(cls, p: Parameters, forward: bool) -> PackedShape:
        """Return these; one is computed, and not stored."""
        return super().packed(p, forward)

    @classmethod
    def as_xy(cls, p: Parameters) -> dict[str, Tensor]:
        """Return the parameters of the XY phase that is the same but for a constant."""
        found: dict[tuple[int, int], Tensor] = {}
        for name, value in p.items():
            match = _TERM.fullmatch(name)
            if match is None:
                continue
            n, m, sine, norm = cls.term(int(match[1]))
            for powers, factor in _monomials(n, m, sine):
                if powers != (0, 0):
                    term = (_RADIANS * norm * factor) * value
                    found[powers] = found[powers] + term if powers in found else term
        named = {_name(i, j): value for (i, j), value in found.items()}
        return {"order": p["order"], "norm_radius": p["norm_radius"], **named}

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return -2·(the mean over azimuth of the coefficient of r² in the path)."""
        return XYPhase.paraxial_power(cls.as_xy(p))

    @classmethod
    def section_power(cls, p: Parameters, cosine: Number, sine: Number) -> ParaxialPower:
        """Return that of the same phase as a polynomial."""
        return XYPhase.section_power(cls.as_xy(p), cosine, sine)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return the mean over azimuth of the coefficient of r⁴ in the path.

        Raises:
            InputError: a term that no Seidel sum describes is not zero.
        """
        return XYPhase.fourth_order_path(cls.as_xy(p))


@cache
def _monomials(n: int, m: int, sine: bool) -> tuple[tuple[tuple[int, int], float], ...]:
    """Return the coefficients of u^i·v^j in R_n^m(ρ)·cos(mφ), or sin(mφ), exact whole numbers."""
    found: dict[tuple[int, int], int] = {}
    for s in range((n - m) // 2 + 1):
        half = (n - m) // 2 - s
        radial = (
            (-1) ** s
            * math.factorial(n - s)
            // (math.factorial(s) * math.factorial((n + m) // 2 - s) * math.factorial(half))
        )
        for a in range(half + 1):  # (u² + v²)^half
            for b in range(int(sine), m + 1, 2):  # (u + i·v)^m
                sign = (-1) ** (b // 2)
                powers = (2 * (half - a) + m - b, 2 * a + b)
                whole = radial * math.comb(half, a) * math.comb(m, b) * sign
                found[powers] = found.get(powers, 0) + whole
    return tuple((powers, float(whole)) for powers, whole in found.items() if whole)


def _name(i: int, j: int) -> str:
    return "".join(
        letter + (str(power) if power > 1 else "")
        for letter, power in (("x", i), ("y", j))
        if power
    )


@register_phase
class ZernikeFringePhase(ZernikePhase):
    """The polynomials are in the University of Arizona's order, 1 at the disc's edge ("fringe")."""

    type: ClassVar[str] = "zernike_fringe"  # type: ignore[assignment]
    kind = "Zernike phase"
    terms = FRINGE_TERMS
    term = staticmethod(fringe)


@register_phase
class ZernikeStandardPhase(ZernikePhase):
    """The polynomials are in Noll's order with unit variance over the disc ("standard").

    They end with the radial order 12, beyond which the monomials of paraxial properties lose too
    many digits.
    """

    type: ClassVar[str] = "zernike_standard"  # type: ignore[assignment]
    kind = "Zernike phase"
    terms = 91
    term = staticmethod(noll)
