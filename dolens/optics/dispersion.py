"""Dispersion formulas of glass catalogues: index against wavelength, as pure functions.

All take the wavelength in µm, the unit that catalogues print coefficients for, as a number or as a
tensor of any shape, a constant term, and the rest of the coefficients in pairs; a number gives a
number in double precision, a tensor a tensor of its shape and precision, differentiable in the
wavelength.  Wavelengths are those in air, as of the spectral lines that makers measure.  They are
formulas 1, 2, 3 and 5 in the numbering of refractiveindex.info.
"""

from collections.abc import Callable
from typing import TypeVar

from torch import Tensor

Wavelength = TypeVar("Wavelength", float, Tensor)
Terms = tuple[tuple[float, float], ...]
Formula = Callable[[float | Tensor, float, Terms], float | Tensor]


def sellmeier(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = 1 + constant + Σ B λ² / (λ² - C²), with (B, C) in `terms`, C in µm: resonances."""
    square = wavelength * wavelength
    return (1.0 + constant + sum(b * square / (square - c * c) for b, c in terms)) ** 0.5


def sellmeier_squared(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = 1 + constant + Σ B λ² / (λ² - C), with (B, C) in `terms`, C in µm².

    The form that Schott, Ohara and CDGM print.  With three, four and five terms it is what Zemax
    calls Sellmeier 1, 3 and 5.
    """
    square = wavelength * wavelength
    return (1.0 + constant + sum(b * square / (square - c) for b, c in terms)) ** 0.5


def polynomial(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = constant + Σ a λᵉ, with (a, e) in `terms`.

    Exponents 2, -2, -4, -6, -8 make it the older Schott formula; Hoya, Hikari and Sumita print it,
    some with 4, -10 or -12 besides.
    """
    return (constant + sum(a * wavelength**e for a, e in terms)) ** 0.5


def cauchy(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n = constant + Σ a λᵉ, with (a, e) in `terms`; exponents are usually -2 and -4."""
    return constant + sum(a * wavelength**e for a, e in terms)
