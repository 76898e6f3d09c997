"""Dispersion formulas of glass catalogues: index against wavelength, as pure functions.

All take the wavelength in µm, the unit that catalogues print coefficients for, as a number or as a
tensor of any shape, a constant term, and the rest of the coefficients in pairs; a number gives a
number in double precision, a tensor a tensor of its shape and precision, differentiable in the
wavelength.  Wavelengths are those in air, as of the spectral lines that makers measure.
`dolens.optics.agf_formulas` says which of them the formulas 1 to 13 of `.agf` catalogues are.
"""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from dolens.errors import InputError

Wavelength = float | Tensor
Terms = tuple[tuple[float, float], ...]
Formula = Callable[[Wavelength, float, Terms], Wavelength]

# µm²: Herzberger's L = 1/(λ² - 0.028), the same for all media.
_HERZBERGER = 0.028
# nm: from the vacuum ultraviolet to millimetre waves; what lies beyond is another unit, µm or m.
SHORTEST, LONGEST = 50.0, 1e7


def require_wavelengths(wavelengths: Iterable[float], where: str = "", unit: str = "nm") -> None:
    """Raise `InputError` where a wavelength in nm is none of light: not from 50 nm to 10 mm.

    Args:
        wavelengths: nm.
        where: what the message begins with, a file or a key.
        unit: in which they were given, `nm` or `µm`; the message names it.
    """
    for wavelength in wavelengths:
        if not SHORTEST <= wavelength <= LONGEST:
            before = f"{where}: " if where else ""
            given = wavelength if unit == "nm" else 1e-3 * wavelength
            hint = "0.55 µm is 550" if unit == "nm" else "550 nm is 0.55"
            raise InputError(
                f"{before}wavelength {given:g} {unit}: allowed: 50 nm to 10 mm "
                f"(wavelengths are in {unit}, so {hint})"
            )


def require_wavelength(wavelength: float | Tensor) -> None:
    """Raise `InputError` where a wavelength, or one of a tensor on the CPU, is none of light; on
    another device that would wait for it.
    """
    if not (isinstance(wavelength, Tensor) and wavelength.is_cuda):
        require_wavelengths(extremes(wavelength))


def extremes(wavelength: float | Tensor) -> list[float]:
    """Shortest and longest wavelength, or nothing where they cannot be looked at."""
    if not isinstance(wavelength, Tensor):
        return [wavelength]
    if torch.compiler.is_compiling() or wavelength.numel() == 0 or wavelength.is_meta:
        return []
    if wavelength.is_cuda and torch.cuda.is_current_stream_capturing():
        return []
    # The values beneath vmap and the like: read once, and never part of the result.
    plain = torch.func.debug_unwrap(wavelength.detach(), recurse=True)
    # What is computed from them within vjp is wrapped again: PyTorch 2.9 gives no list of it.
    return [value.item() for value in torch.aminmax(plain)]


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


def sellmeier_with_offset(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = constant + Σ B λ² / (λ² - C), with (B, C) in `terms`, C in µm²: Zemax's Sellmeier 4."""
    square = wavelength * wavelength
    return (constant + sum(b * square / (square - c) for b, c in terms)) ** 0.5


def sellmeier_with_pole(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = 1 + constant + B λ² / (λ² - C²) + D / (λ² - E²), with (B, C), (D, E) in `terms`, C and E
    in µm: Zemax's Sellmeier 2.
    """
    square = wavelength * wavelength
    (b, c), (d, e) = terms
    return (1.0 + constant + b * square / (square - c * c) + d / (square - e * e)) ** 0.5


def pole_and_powers(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = constant + B / (λ² - C) + Σ a λᵉ, with (B, C) first in `terms` and then (a, e).

    With one power, -D λ², it is the first formula of the Handbook of Optics.
    """
    square = wavelength * wavelength
    (b, c), *powers = terms
    return (constant + b / (square - c) + sum(a * wavelength**e for a, e in powers)) ** 0.5


def resonance_and_powers(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = constant + B λ² / (λ² - C) + Σ a λᵉ, with (B, C) first in `terms` and then (a, e).

    With one power, -D λ², it is the second formula of the Handbook of Optics.
    """
    square = wavelength * wavelength
    (b, c), *powers = terms
    return (constant + b * square / (square - c) + sum(a * wavelength**e for a, e in powers)) ** 0.5


def polynomial(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n² = constant + Σ a λᵉ, with (a, e) in `terms`.

    Exponents 2, -2, -4, -6, -8 make it the older Schott formula; Hoya, Hikari and Sumita print it,
    some with 4, -10 or -12 besides.
    """
    return (constant + sum(a * wavelength**e for a, e in terms)) ** 0.5


def cauchy(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n = constant + Σ a λᵉ, with (a, e) in `terms`; exponents are usually -2 and -4.

    Exponents -1 and -3.5 make it Conrady's formula.
    """
    return constant + sum(a * wavelength**e for a, e in terms)


def herzberger(wavelength: Wavelength, constant: float, terms: Terms) -> Wavelength:
    """n = constant + B L + C L² + Σ a λᵉ with L = 1/(λ² - 0.028 µm²).

    The first two of `terms` are (B, 1) and (C, 2), powers of L; the others are (a, e), powers of λ.
    """
    pole = 1.0 / (wavelength * wavelength - _HERZBERGER)
    of_pole = sum(a * pole**e for a, e in terms[:2])
    return constant + of_pole + sum(a * wavelength**e for a, e in terms[2:])
