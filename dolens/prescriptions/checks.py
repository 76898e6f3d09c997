"""Plain values are checked: each mistake is one line that says where and what is allowed."""

import math
from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, comma_hint


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


# Keys whose text is no number, even where it reads like one; states are lenses of their own.
_WORDS = ("name", "note", "source", "published", "states")


def check_range(value: object, dtype: torch.dtype, where: str, key: str = "") -> None:
    """Refuse numbers of a prescription that the precision of a lens cannot hold.

    Those are finite numbers beyond its largest, and curvatures whose squares, which sags have, are.

    Args:
        value: a prescription, or a part of it.
        dtype: of the lens.
        where: names the part in messages.
        key: of the part.

    Raises:
        InputError: one line that names the surface and the key.
    """
    if isinstance(value, Mapping):
        for name, entry in value.items():
            if name in _WORDS:
                continue
            if isinstance(entry, Mapping):
                place = f"surface {name}" if key == "surfaces" else str(name)
                inner = where if name == "surfaces" else f"{where}: {place}"
                check_range(entry, dtype, inner, str(name))
            else:
                check_range(entry, dtype, where, str(name))
        return
    if isinstance(value, list | tuple):
        for entry in value:
            check_range(entry, dtype, where, key)
        return
    try:
        number = abs(float(value))  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return  # no number: for others to use or to refuse
    most = torch.finfo(dtype).max
    if key.startswith("curvature"):
        most = math.sqrt(most)
    least = 1.0 / math.sqrt(most) if key.startswith("radius") else 0.0
    precision = str(dtype).removeprefix("torch.")
    if most < number < math.inf:
        raise InputError(f"{where}: '{key}' is {value}; {precision} holds {most:.4g} at most")
    if 0.0 < number < least:
        words = f"too small for a surface in {precision}: {least:.4g} at least"
        raise InputError(f"{where}: '{key}' is {float(value):g}, {words}")  # type: ignore[arg-type]
