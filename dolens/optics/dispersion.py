"""Dispersion formulas: refractive index against wavelength, as pure functions; and model glasses.

All take the wavelength in µm, the unit that catalogues print coefficients for, as a number or as a
tensor of any shape, a constant term, and the rest of the coefficients in pairs; a number gives a
number in double precision, a tensor a tensor of its shape and precision, differentiable in the
wavelength.  Wavelengths are those in air, as of the spectral lines that makers measure.
`dolens.optics.agf` says which of them the formulas 1 to 13 of `.agf` catalogues are.

Glass by nd, Vd and ΔPgF: a model of a glass that no catalogue lists.

A glass's partial dispersion PgF = (ng - nF)/(nF - nC) lies near Schott's normal line, through the
glasses K7 and F2, and ΔPgF is its distance from that line:

    PgF = 0.6438 - 0.001682 Vd + ΔPgF

Conrady's formula n = n0 + A/λ + B/λ^3.5 has three constants, and the model's are those that give
nd, nF - nC and PgF exactly.  Glasses of Schott and Ohara within 0.005 of the normal line, modelled
by nd and Vd alone (ΔPgF = 0), are met within 4e-5 from 480 to 656 nm and within 2e-4 at 436 nm.
A polynomial in 1/λ² through the same three numbers errs by three times as much.

Zemax's own formula for model glass is not published.  Its makers say that it takes nd, Vd and ΔPgF
from this normal line, and that it is accurate to about 1e-4 in the visible (Zemax Knowledge Base,
"How to Use the Model Glass", 2005).  So differences of that size are to be expected.  At the lines
themselves they are smaller: the foci that OpticStudio has written into 15 files are met within 1e-6
of the focal length here, and would be within 2e-8 if nd, nF and nC were those at 587.6, 486.1 and
656.3 nm.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

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


# Mercury's g line, nm.
LINE_G = 435.8343
# Schott's normal line (TIE-29).
_NORMAL_OFFSET, _NORMAL_SLOPE = 0.6438, -0.001682
# Powers of λ in Conrady's formula.
_FIRST, _SECOND = -1.0, -3.5
NM_PER_UM = 1000.0


@dataclass(frozen=True)
class ModelGlass:
    """A medium with index n(λ) = n0 + A/λ + B/λ^3.5, λ in µm.

    Attributes:
        name: nd/Vd/ΔPgF as a prescription writes it.
        constant: n0.
        a: µm.
        b: µm^3.5.
    """

    name: str
    constant: float
    a: float
    b: float

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Refractive index at a wavelength in nm.

        A number gives a number (in double precision, whatever the rays' precision);
        a tensor gives a tensor of its shape.

        Raises:
            InputError: the number is no wavelength of light.
        """
        require_wavelength(wavelength)
        micrometres = wavelength / NM_PER_UM
        return self.constant + self.a * micrometres**_FIRST + self.b * micrometres**_SECOND


def normal_partial_dispersion(vd: float) -> float:
    """Return PgF of Schott's normal line at an Abbe number."""
    return _NORMAL_OFFSET + _NORMAL_SLOPE * vd


def deviation_of_two_terms(vd: float, lines: tuple[float, float, float]) -> float:
    """Return ΔPgF of the two-term formula A + B/λ² that nd/Vd alone stands for.

    Args:
        vd: Abbe number.
        lines: C, d and F in nm.
    """
    c, _, f = (line**-2 for line in lines)
    return (LINE_G**-2 - f) / (f - c) - normal_partial_dispersion(vd)


def model_glass(
    name: str, nd: float, vd: float, deviation: float, lines: tuple[float, float, float]
) -> ModelGlass:
    """Return the glass with this nd, Vd = (nd - 1)/(nF - nC) and ΔPgF.

    Args:
        name: of the medium.
        nd: index at the line d.
        vd: Abbe number, not 0.
        deviation: ΔPgF.
        lines: C, d and F in nm; g is 435.8343 nm.
    """
    c, d, f, g = (line / NM_PER_UM for line in (*lines, LINE_G))
    dispersion = (nd - 1.0) / vd
    partial = (normal_partial_dispersion(vd) + deviation) * dispersion
    # A u + B v over (C, F) is nF - nC, and over (F, g) it is ng - nF.
    u1, v1 = f**_FIRST - c**_FIRST, f**_SECOND - c**_SECOND
    u2, v2 = g**_FIRST - f**_FIRST, g**_SECOND - f**_SECOND
    determinant = u1 * v2 - u2 * v1
    a = (dispersion * v2 - partial * v1) / determinant
    b = (u1 * partial - u2 * dispersion) / determinant
    return ModelGlass(name, nd - a * d**_FIRST - b * d**_SECOND, a, b)
