"""Plans that are made for less than the tolerance until they keep to it."""

from collections.abc import Callable
from typing import TypeVar

_ROUNDS = 4

Found = TypeVar("Found")


def tightened(
    attempt: Callable[[float], tuple[float, Found]], tolerance: float
) -> tuple[float, Found]:
    """The first plan whose measured error is within a tolerance, or else the best of four.

    What a plan errs by is not quite what it expects: each round asks for less, in proportion to
    what the last one erred by.

    Args:
        attempt: a tolerance to plan for → the error that was measured, and the plan.
        tolerance: of the measured error.
    """
    share, best = 1.0, None
    for _ in range(_ROUNDS):
        error, found = attempt(share * tolerance)
        if best is None or error < best[0]:
            best = error, found
        if error <= tolerance:
            break
        share *= max(0.25, 0.7 * tolerance / error)
    return best
