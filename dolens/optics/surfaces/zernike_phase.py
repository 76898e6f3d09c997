"""Phases that are sums of Zernike polynomials: wavefront errors that were measured, or are wanted.

Zernike polynomials are polynomials in x and y, so that the kernels are those of an XY phase: its
coefficients are sums of these ones.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.surfaces.base import Parameters
from dolens.optics.surfaces.deflection import Number, ParaxialPower
from dolens.optics.surfaces.phase import Phase, XYPhase, register_phase
from dolens.optics.surfaces.registry import order_of, order_pattern
from dolens.optics.surfaces.zernike import FRINGE_TERMS, ZernikeTerm, fringe, jacobi, noll

_TERM = order_pattern("z")
_RADIANS = 2.0 * math.pi


class ZernikePhase(Phase):
    """The phase is φ = 2π·Σ z_j·(Z_j(x/R, y/R) - Z_j(0, 0)) with R = norm_radius; coefficients in
    waves.

    Polynomials go on beyond the radius.  A constant phase, which no ray sees, is left out.
    """

    kernel = XYPhase.kernel
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
    def phase_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the phase and its gradient, by the recurrence of Jacobi polynomials."""
        inverse = 1.0 / p["norm_radius"]
        u, v = inverse * x, inverse * y
        q = torch.addcmul(u * u, v, v)
        phase, du, dv = torch.zeros_like(q), torch.zeros_like(q), torch.zeros_like(q)
        for name, value in p.items():
            match = _TERM.fullmatch(name)
            if match is None:
                continue
            n, m, sine, norm = cls.term(int(match[1]))
            *_, (radial, slope) = jacobi(q, m, (n - m) // 2 + 1)
            # ρ^m·cos(mφ) or ρ^m·sin(mφ), and its derivatives.
            power, below = _powers(u, v, m)
            angular, along, across = (
                (power[1], below[1], below[0]) if sine else (power[0], below[0], -below[1])
            )
            coefficient = norm * value
            middle = (-1.0) ** (n // 2) if m == 0 else 0.0
            phase = phase + coefficient * (angular * radial - middle)
            du = du + coefficient * (m * along * radial + 2.0 * u * angular * slope)
            dv = dv + coefficient * (m * across * radial + 2.0 * v * angular * slope)
        scale = _RADIANS * p["order"]
        return scale * phase, (scale * inverse) * du, (scale * inverse) * dv

    @classmethod
    def packed(cls, p: Parameters, forward: bool) -> tuple[Tensor | None, ...]:
        """Return the numbers of the XY phase that is the same: order, radius, coefficients."""
        return XYPhase.packed(cls.as_xy(p), forward)

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


def _powers(u: Tensor, v: Tensor, m: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return real and imaginary part of (u + i·v)^m, and of the next lower power (0 for m = 0)."""
    real, imaginary = torch.ones_like(u), torch.zeros_like(u)
    below = (torch.zeros_like(u), torch.zeros_like(u))
    for _ in range(m):
        below = (real, imaginary)
        real, imaginary = real * u - imaginary * v, imaginary * u + real * v
    return (real, imaginary), below


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

    They end with the radial order 12, beyond which monomials lose too many digits.
    """

    type: ClassVar[str] = "zernike_standard"  # type: ignore[assignment]
    kind = "Zernike phase"
    terms = 91
    term = staticmethod(noll)
