"""A series in the wavelength, as texts write it: `1.5868+8.14e-3/w2`, w being λ in µm.

It is Cauchy's formula of an index, and of the coefficients of a gradient-index profile.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from dolens.optics.dispersion import NM_PER_UM, Terms, cauchy, require_wavelength

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_POWER = r"[*/]w(?:1[0-2]|[1-9])"
_PART = re.compile(rf"([+-]?{_NUMBER})({_POWER})?", re.IGNORECASE)
_SERIES = re.compile(rf"[+-]?{_NUMBER}(?:{_POWER})?(?:[+-]{_NUMBER}(?:{_POWER})?)*", re.IGNORECASE)


@dataclass(frozen=True)
class WavelengthSeries:
    """A number changes with the wavelength: constant + Σ a·λᵉ, λ in µm.

    Attributes:
        constant: its part that does not.
        terms: (a, e), each exponent once, none of them zero.
    """

    constant: float
    terms: Terms = ()

    @property
    def name(self) -> str:
        """Return the series as `parse_series` reads it."""
        return f"{self.constant!r}{power_text(self.terms)}"

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return its value at a wavelength in nm, as other media do.

        Raises:
            InputError: the number is no wavelength of light.
        """
        require_wavelength(wavelength)
        return cauchy(wavelength / NM_PER_UM, self.constant, self.terms)

    def times(self, other: "WavelengthSeries") -> "WavelengthSeries":
        """Return the product of two series."""
        found: dict[float, float] = {}
        for a, e in ((self.constant, 0), *self.terms):
            for b, f in ((other.constant, 0), *other.terms):
                found[e + f] = found.get(e + f, 0.0) + a * b
        return series_of(found)


def series_of(coefficients: Mapping[float, float]) -> WavelengthSeries:
    """Return the series of these coefficients by exponent; those that are zero are left out."""
    terms = tuple((a, e) for e, a in sorted(coefficients.items(), reverse=True) if e and a)
    return WavelengthSeries(coefficients.get(0, 0.0), terms)


def power_text(terms: Terms) -> str:
    """Return the terms of a series behind its constant: `+0.00814/w2`."""
    return "".join(f"{'-' if a < 0.0 else '+'}{abs(a)!r}{'/*'[e > 0]}w{abs(e):g}" for a, e in terms)


def parse_series(text: str) -> WavelengthSeries | None:
    """Return the series that a text writes; None where it is none, or no number of it is finite."""
    if not _SERIES.fullmatch(text):
        return None
    found: dict[float, float] = {}
    for part in _PART.finditer(text):
        power = part[2] or "*w0"
        exponent = int(power[2:]) * (1 if power[0] == "*" else -1)
        found[exponent] = found.get(exponent, 0.0) + float(part[1])
    return series_of(found) if all(map(math.isfinite, found.values())) else None
