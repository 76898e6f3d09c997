"""Checks of settings that experiments share."""

from typing import Any

from dolens.errors import InputError


def numbers_of(key: str, values: Any, count: int | None = None) -> list[float]:
    """Return numbers of a configuration as floats.

    Args:
        key: their name, for messages.
        values: as they were given.
        count: the number that is needed; None: any.

    Raises:
        InputError: a value is no number, or their count is another one.
    """
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        raise InputError(f"{key}: must be numbers, not {values!r}") from None
    if count is not None and len(numbers) != count:
        raise InputError(f"{key}: {count} numbers are needed, not {len(numbers)}")
    return numbers
