"""Numbers of a configuration are checked: each mistake is one line with the key and its range."""

import math
from typing import Any

from dolens.errors import InputError


def numbers_of(key: str, values: Any, count: int | None = None) -> list[float]:
    """Return numbers of a configuration as floats.

    Args:
        key: their name in messages.
        values: as they were given.
        count: how many there must be; None: any.

    Raises:
        InputError: something else, or another count.
    """
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        raise InputError(f"{key}: must be numbers, not {values!r}") from None
    if count is not None and len(numbers) != count:
        raise InputError(f"{key}: {count} numbers are needed, not {len(numbers)}")
    return numbers


def check_count(key: str, number: Any, least: int = 1) -> None:
    """Refuse what is no integer of `least` or more.

    Raises:
        InputError: it is none.
    """
    if not (type(number) is int and number >= least):
        raise InputError(f"{key}: {number!r}; allowed: an integer of {least} or more")


def check_positive(key: str, number: Any) -> None:
    """Refuse what is no positive, finite number.

    Raises:
        InputError: it is none.
    """
    if not (isinstance(number, int | float) and 0.0 < number < math.inf):
        raise InputError(f"{key}: {number!r}; allowed: a positive number")


def check_not_negative(key: str, number: Any) -> None:
    """Refuse what is no finite number of 0 or more.

    Raises:
        InputError: it is none.
    """
    if not (isinstance(number, int | float) and 0.0 <= number < math.inf):
        raise InputError(f"{key}: {number!r}; allowed: a number of 0 or more")
