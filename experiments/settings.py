"""What experiments make of their settings."""

from typing import Any

from dolens.errors import InputError


def numbers_of(key: str, values: Any, count: int | None = None) -> list[float]:
    """Numbers of a configuration, as floats.

    Args:
        key: what messages call them.
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
