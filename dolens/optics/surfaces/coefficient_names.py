"""Coefficients are named by a letter and their order, such as `a4`, `z11` and `x2y`."""

import re

from dolens.errors import InputError

# No prescription goes so far, and a surface takes time and memory for every order below it.
HIGHEST_ORDER = 400


def order_pattern(letter: str, first: int = 1) -> re.Pattern[str]:
    """Return what matches names of a letter and an order from 0 or 1, without leading zeros."""
    return re.compile(f"{letter}({'0|' if first == 0 else ''}[1-9][0-9]*)")


def checked_order(digits: str, name: str) -> int:
    """Return the order that the digits of a name give.

    Raises:
        InputError: it is beyond what a surface can have.
    """
    # Digits without end are not read.
    order = int(digits) if len(digits) <= len(str(HIGHEST_ORDER)) else HIGHEST_ORDER + 1
    if order > HIGHEST_ORDER:
        raise InputError(f"'{name}': the highest order of a coefficient is {HIGHEST_ORDER}")
    return order


def order_of(pattern: re.Pattern[str], name: object) -> int | None:
    """Return the order of a coefficient whose name the pattern matches; None for another name.

    Raises:
        InputError: it is beyond what a surface can have.
    """
    match = pattern.fullmatch(str(name))
    return None if match is None else checked_order(match[1], str(name))
