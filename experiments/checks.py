"""Numbers of a configuration are checked: each mistake is one line with the key and its range."""

import math
from typing import Any

from dolens.errors import InputError
from dolens.optics.lens import Lens


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


def check_finite(key: str, number: Any) -> None:
    """Refuse what is no finite number.

    Raises:
        InputError: it is none.
    """
    if isinstance(number, bool) or not (
        isinstance(number, int | float) and -math.inf < number < math.inf
    ):
        raise InputError(f"{key}: {number!r}; allowed: a number")


def check_sensor_distance(lens: Lens, key: str) -> None:
    """Refuse a lens with the sensor in front of its last surface, where no light comes to.

    Args:
        lens: the lens.
        key: of its prescription.

    Raises:
        InputError: it has one.
    """
    distance = float(lens.sensor_distance.detach())
    if lens.system().senses[-1] * distance < 0.0:
        raise InputError(
            f"{key}.sensor.distance: {distance:g} mm; the sensor must stand behind the last "
            "surface as light travels (negative where it travels towards -z)"
        )
