"""The dispersion formulas of `.agf` glass catalogues, numbered from 1 to 13 as Zemax does.

A catalogue's line CD lists up to ten coefficients of the formula that its line NM numbers.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from dolens.errors import InputError
from dolens.optics.dispersion import (
    Formula,
    Terms,
    cauchy,
    herzberger,
    pole_and_powers,
    polynomial,
    resonance_and_powers,
    sellmeier_squared,
    sellmeier_with_offset,
    sellmeier_with_pole,
)


class Dispersion(NamedTuple):
    """A dispersion formula and its coefficients, see `dolens.optics.dispersion`."""

    formula: Formula
    constant: float
    terms: Terms


def agf_dispersion(number: int, coefficients: Sequence[float]) -> Dispersion:
    """Return the formula of that number with the coefficients of a catalogue's line CD.

    Args:
        number: 1 Schott, 2 Sellmeier 1, 3 Herzberger, 4 Sellmeier 2, 5 Conrady, 6 Sellmeier 3,
            7 and 8 Handbook of Optics 1 and 2, 9 Sellmeier 4, 10 Extended, 11 Sellmeier 5,
            12 Extended 2, 13 Extended 3.
        coefficients: in the catalogue's order, for µm; those left out are 0.

    Raises:
        InputError: there is no such formula, or one with fewer coefficients.
    """
    if number not in _FORMULAS:
        raise InputError(f"dispersion formula {number} is unknown (allowed: 1 to 13)")
    count, make = _FORMULAS[number]
    if any(coefficients[count:]):
        raise InputError(
            f"dispersion formula {number} has {count} coefficients, and more are given"
        )
    padded = [float(value) for value in coefficients[:count]]
    return make(padded + [0.0] * (count - len(padded)))


def _pairs(values: Sequence[float]) -> Terms:
    """Return strengths and resonances, without those of no strength."""
    pairs = zip(values[::2], values[1::2], strict=True)
    return tuple((b, c) for b, c in pairs if b != 0.0)


def _powers(values: Sequence[float], exponents: Sequence[float]) -> Terms:
    return tuple((a, e) for a, e in zip(values, exponents, strict=True) if a != 0.0)


def _sellmeier(values: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_squared, 0.0, _pairs(values))


def _series(*exponents: float) -> tuple[int, Callable[[Sequence[float]], Dispersion]]:
    def make(values: Sequence[float]) -> Dispersion:
        return Dispersion(polynomial, values[0], _powers(values[1:], exponents))

    return len(exponents) + 1, make


def _herzberger(v: Sequence[float]) -> Dispersion:
    return Dispersion(herzberger, v[0], tuple(zip(v[1:], (1.0, 2.0, 2.0, 4.0, 6.0), strict=True)))


def _sellmeier_2(v: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_with_pole, v[0], ((v[1], v[2]), (v[3], v[4])))


def _conrady(v: Sequence[float]) -> Dispersion:
    return Dispersion(cauchy, v[0], _powers(v[1:], (-1.0, -3.5)))


def _handbook(formula: Formula) -> Callable[[Sequence[float]], Dispersion]:
    def make(v: Sequence[float]) -> Dispersion:
        return Dispersion(formula, v[0], ((v[1], v[2]), (-v[3], 2.0)))

    return make


def _sellmeier_4(v: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_with_offset, v[0], _pairs(v[1:]))


# Number → how many coefficients it has, and what they mean.
_FORMULAS: dict[int, tuple[int, Callable[[Sequence[float]], Dispersion]]] = {
    1: _series(2.0, -2.0, -4.0, -6.0, -8.0),
    2: (6, _sellmeier),
    3: (6, _herzberger),
    4: (5, _sellmeier_2),
    5: (3, _conrady),
    6: (8, _sellmeier),
    7: (4, _handbook(pole_and_powers)),
    8: (4, _handbook(resonance_and_powers)),
    9: (5, _sellmeier_4),
    10: _series(2.0, -2.0, -4.0, -6.0, -8.0, -10.0, -12.0),
    11: (10, _sellmeier),
    12: _series(2.0, -2.0, -4.0, -6.0, -8.0, 4.0, 6.0),
    13: _series(2.0, 4.0, -2.0, -4.0, -6.0, -8.0, -10.0, -12.0),
}
