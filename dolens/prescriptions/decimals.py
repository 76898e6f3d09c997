"""Decimal text and double precision are converted to each other without losing a bit."""

import math
from decimal import Context, Decimal
from fractions import Fraction

from dolens.errors import InputError, comma_hint

# Any radius with more digits than this was written for its curvature's sake.
_DIGITS_OF_A_DOUBLE = 17
_RECIPROCAL = Context(prec=40)
# Longer text is no number that a program writes, and is slow to read.
_LONGEST = 400


def number_in_text(text: str, place: str) -> float:
    """Read a finite number as files write it (`1.5`, `-2E-3`); `InputError` names the place."""
    if len(text) > _LONGEST:
        raise InputError(f"{place} must be a number, not {len(text)} letters")
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{place} must be a number, not '{text}'{comma_hint(text)}") from None
    if not math.isfinite(value) or "_" in text:
        raise InputError(f"{place} must be a finite number, not '{text}'")
    return value


def scaled(text: str, factor: Fraction, place: str) -> float:
    """Return the double nearest to the decimal number times an exact factor (a change of units)."""
    value = number_in_text(text, place)
    # Zero and exponents out of range ended above: the exact fraction below stays small.
    return value if value == 0.0 or factor == 1 else nearest(Fraction(text) * factor, place)


def exact(text: str, place: str) -> Fraction:
    """Return the decimal number itself; `InputError` where it is none of double precision."""
    return Fraction(text) if number_in_text(text, place) else Fraction(0)


def shifted(value: float, places: int) -> str:
    """Return decimal text of value·10^places, exact for the shortest text that means the value."""
    return str(Decimal(repr(value)).scaleb(places))


def reciprocal(value: float) -> str:
    """Return text of 1/value with 40 digits, from which `curvature_in_text` recovers every bit."""
    return str(_RECIPROCAL.divide(Decimal(1), Decimal(value)))


def curvature_in_text(text: str, place: str) -> float | None:
    """Return the curvature whose radius has more digits than a double; None for an ordinary
    radius.
    """
    radius = number_in_text(text, place)
    digits = Decimal(text).normalize().as_tuple().digits
    if radius == 0.0 or len(digits) <= _DIGITS_OF_A_DOUBLE:
        return None
    return nearest(1 / Fraction(text), place)


def nearest(number: Fraction, place: str) -> float:
    """Return the double nearest to a fraction; `InputError` where it is out of range."""
    try:
        return float(number)
    except OverflowError:
        raise InputError(f"{place} is out of the range of double precision") from None


def radius_of(curvature: float) -> float | None:
    """Return the radius with the fewest digits whose reciprocal is the curvature; None if there is
    none.

    Infinite for curvature 0.  1/R in double precision skips some curvatures.
    """
    if curvature == 0.0:
        return math.inf
    for digits in range(1, _DIGITS_OF_A_DOUBLE + 1):
        radius = float(f"{1.0 / curvature:.{digits}g}")
        if radius != 0.0 and 1.0 / radius == curvature:
            return radius
    return None
