"""Plain values are checked: each mistake is one line that says where and what is allowed."""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.decimals import comma_hint


def as_number(value: object, what: str, finite: bool = True) -> float:
    """Return a number; raise `InputError`, which names `what`, where the value is none, or an
    infinite one that has to be finite.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a number, not {value!r}{comma_hint(value)}") from None
    if math.isnan(number) or (finite and math.isinf(number)):
        raise InputError(f"{what} must be a finite number, not {value!r}")
    return number


def as_positive(value: object, what: str) -> float:
    """Return a finite number above zero."""
    found = as_number(value, what)
    if found <= 0.0:
        raise InputError(f"{what} must be positive, not {value!r}")
    return found


def as_numbers(value: object, what: str) -> Any:
    """Return a number, or rows of numbers nested as they are written."""
    if isinstance(value, list | tuple):
        return [as_numbers(entry, what) for entry in value]
    return as_number(value, what)


def as_integer(value: object, what: str) -> int:
    """Return a whole number."""
    number = as_number(value, what)
    if number != int(number):
        raise InputError(f"{what} must be a whole number, not {value!r}")
    return int(number)


def require_mapping(value: object, where: str) -> None:
    """Raise `InputError` where a value is no mapping."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: expected a mapping of keys to values, not {value!r}")
