"""Most shapes give their kernel the parameters themselves."""

from collections.abc import Callable
from typing import Any, TypeVar

_Packed = TypeVar("_Packed", bound=Callable[..., Any])


def by_names(packed: _Packed) -> _Packed:
    """Mark a `packed` that returns stored parameters, chosen by their names and shapes alone.

    What such a method returned holds for any values of the same parameters, so that a lens whose
    shapes have no other need not be asked at every trace.  Overriding a method takes its mark away.
    """
    packed.by_names = True  # type: ignore[attr-defined]
    return packed


def is_by_names(packed: Callable[..., Any]) -> bool:
    """Return whether a `packed` has the mark."""
    return getattr(packed, "by_names", False)
