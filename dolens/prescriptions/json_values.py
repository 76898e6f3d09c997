"""Values of other programs' JSON files are looked up and checked."""

from collections.abc import Iterable, Iterator
from decimal import Decimal
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.decimals import nearest


class Watched(dict[str, Any]):
    """A `Watched` is a mapping that remembers which of its keys were looked up.

    Args:
        content: the values of another program's file; mappings in them are watched too.
    """

    def __init__(self, content: dict[str, Any]) -> None:
        super().__init__({key: _watched(value) for key, value in content.items()})
        self.seen: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        """Return a value, and remember its key."""
        self.seen.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a value, and remember its key."""
        self.seen.add(key)
        return super().get(key, default)


def _watched(value: Any) -> Any:
    if isinstance(value, list):
        return [_watched(entry) for entry in value]
    return Watched(value) if isinstance(value, dict) else value


def passed_over(content: Watched) -> list[str]:
    """Return the keys that hold something and were not looked up, such as `ray_tracer`.

    Places in lists are left out, so that a key of many surfaces is named once.
    """
    return list(dict.fromkeys(f"'{path}'" for path in _unread(content, "")))


def _unread(value: Any, path: str) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _unread(entry, path)
    if isinstance(value, Watched):
        for key, entry in value.items():
            # Names of classes, and what a program's objects wrap their values in, say nothing.
            inner = path if key == "attributes" else f"{path}.{key}".lstrip(".")
            if key in value.seen or key == "attributes":
                yield from _unread(entry, inner)
            elif not key.startswith("__") and _says(entry):
                yield inner


def _says(value: Any) -> bool:
    """Return whether a value is other than nothing, zero or a mapping or list of such."""
    if isinstance(value, dict):
        return any(map(_says, value.values()))
    return any(map(_says, value)) if isinstance(value, list) else value not in _NOTHING


_NOTHING = (None, False, 0, "", "ignore")


def mapping(value: object, place: str) -> dict[str, Any]:
    """Return a mapping; `InputError` where a value is none."""
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected a mapping of keys to values")
    return value


def rows(value: object, place: str) -> list[Any]:
    """Return a list; `InputError` where a value is none."""
    if not isinstance(value, list):
        raise InputError(f"{place}: expected a list")
    return value


def number(content: dict[str, Any], key: str, place: str, default: float | None = None) -> float:
    """Return a finite number of a mapping."""
    if content.get(key) is None:
        if default is None:
            raise InputError(f"{place}: '{key}' is missing")
        return default
    return as_number(content[key], f"{place}: '{key}'")


def difference(later: float, earlier: float, place: str) -> float:
    """Return the double nearest to the difference of two decimals, for gaps between positions."""
    exact = Fraction(Decimal(repr(later))) - Fraction(Decimal(repr(earlier)))
    return nearest(exact, place)


def require_unset(content: dict[str, Any], keys: Iterable[str], what: str, place: str) -> None:
    """Raise `InputError` where one of some keys says anything."""
    for key in keys:
        value = content.get(key)
        if value not in (None, False, 0, 0.0, [], {}, ""):
            raise InputError(f"{place}: {what} is not held ('{key}')")
