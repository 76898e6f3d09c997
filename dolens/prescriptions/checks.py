"""Plain values are checked: each mistake is one line that says where and what is allowed."""

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from dolens.errors import InputError


def as_number(value: object, what: str, finite: bool = True) -> float:
    """Return a number; raise `InputError`, which names `what`, where the value is none."""
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, not {value!r}") from None
    if math.isnan(number) or (finite and math.isinf(number) and "radius" not in what):
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


def check_keys(mapping: Mapping[str, Any], allowed: Iterable[str], where: str) -> None:
    """Raise `InputError` at the first key that is not allowed."""
    allowed = list(allowed)
    for key in mapping:
        if str(key) not in allowed:
            raise InputError(
                f"{where}: unknown key '{key}'{did_you_mean(str(key), allowed)} "
                f"(allowed: {', '.join(allowed)})"
            )


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Return the end of a message about an unknown word: the allowed word that is like it."""
    near = difflib.get_close_matches(word, list(allowed), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
