"""Checks of plain data, with messages that name the place, what was wrong and what is allowed."""

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from dolens.errors import InputError


def number(value: object, what: str, finite: bool = True) -> float:
    """A number, or `InputError` naming `what`; NaN never, infinity only where `finite` is false."""
    try:
        if isinstance(value, bool):
            raise TypeError
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, not {value!r}") from None
    if math.isnan(found) or (finite and math.isinf(found) and "radius" not in what):
        raise InputError(f"{what} must be a finite number, not {value!r}")
    return found


def positive(value: object, what: str) -> float:
    """A finite number above zero, or `InputError` naming `what`."""
    found = number(value, what)
    if found <= 0.0:
        raise InputError(f"{what} must be positive, not {value!r}")
    return found


def numbers(value: object, what: str) -> Any:
    """A number, or rows of numbers nested as they are written."""
    if isinstance(value, list | tuple):
        return [numbers(entry, what) for entry in value]
    return number(value, what)


def integer(value: object, what: str) -> int:
    """A whole number, or `InputError` naming `what`."""
    found = number(value, what)
    if found != int(found):
        raise InputError(f"{what} must be a whole number, not {value!r}")
    return int(found)


def require_mapping(value: object, where: str) -> None:
    """Raise `InputError` unless the value maps keys to values."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: expected a mapping of keys to values, not {value!r}")


def check_keys(mapping: Mapping[str, Any], allowed: Iterable[str], where: str) -> None:
    """Raise `InputError` at the first key that is not allowed, naming one that is near."""
    allowed = list(allowed)
    for key in mapping:
        if str(key) not in allowed:
            raise InputError(
                f"{where}: unknown key '{key}'{near(str(key), allowed)} "
                f"(allowed: {', '.join(allowed)})"
            )


def near(word: str, allowed: Iterable[str]) -> str:
    """A hint at the nearest allowed word, for a message; empty where none is near."""
    found = difflib.get_close_matches(word, list(allowed), n=1)
    return f"; did you mean '{found[0]}'?" if found else ""
