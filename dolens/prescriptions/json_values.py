"""Values of other programs' JSON files are looked up and checked."""

from collections.abc import Iterable
from decimal import Decimal
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.decimals import nearest


def mapping(value: object, place: str) -> dict[str, Any]:
    """Return a mapping; `InputError` where a value is none."""
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected a mapping of keys to values")
    return value


def rows(value: object, place: str) -> list[Any]:
    """Return a list; `InputError` where a value is none."""
    if not isinstance(value, list):
        raise InputError(f"{place}: expected a list")
    return value


def number(content: dict[str, Any], key: str, place: str, default: float | None = None) -> float:
    """Return a finite number of a mapping."""
    if content.get(key) is None:
        if default is None:
            raise InputError(f"{place}: '{key}' is missing")
        return default
    return as_number(content[key], f"{place}: '{key}'")


def difference(later: float, earlier: float, place: str) -> float:
    """Return the double nearest to the difference of two decimals, for gaps between positions."""
    exact = Fraction(Decimal(repr(later))) - Fraction(Decimal(repr(earlier)))
    return nearest(exact, place)


def require_unset(content: dict[str, Any], keys: Iterable[str], what: str, place: str) -> None:
    """Raise `InputError` where one of some keys says anything."""
    for key in keys:
        value = content.get(key)
        if value not in (None, False, 0, 0.0, [], {}, ""):
            raise InputError(f"{place}: {what} is not held ('{key}')")
