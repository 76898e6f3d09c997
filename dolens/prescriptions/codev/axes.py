"""Decenters and tilts of CODE V surfaces are converted to coordinate breaks.

CODE V moves a surface's axes by XDE, YDE and ZDE and then turns them by ADE about x, BDE about y
and CDE about z; ADE and BDE are left-handed, CDE is right-handed.  Here all turns are right-handed,
in the same order.  What follows keeps these axes; with `DAR` the axes in front come back behind
the surface; with `REV` the move is undone behind the surface and not made in front of it; with
`BEN`, for a mirror, the turn is made once more behind it.
"""

from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.codev.file import Block
from dolens.prescriptions.decimals import exact, nearest, scaled

_SHIFTS = {"XDE": "decenter_x", "YDE": "decenter_y"}
# Key → prescription's key, and whether the turn has the other sense.
_TURNS = {"ADE": ("tilt_x", True), "BDE": ("tilt_y", True), "CDE": ("tilt_z", False)}
_OFFSETS = ("XOD", "YOD", "ZOD")
_KINDS = ("DAR", "BEN", "REV")

Break = dict[str, Any]


class Axes:
    """The `Axes` of a surface are the breaks around it.

    Attributes:
        before: break in front of the surface, or None.
        shift_before: mm along z that the break in front adds to the gap in front of it.
        after: break behind the surface, or None.
        shift_after: mm along z that the break behind adds to the gap behind it.
        kind: DAR, BEN, REV, or nothing.
    """

    def __init__(self, block: Block, factor: Fraction, place: str) -> None:
        """Read the decenters and tilts of a surface's block.

        Raises:
            InputError: tilts about a point of their own, two of DAR, BEN and REV, or BEN about two
                axes at once.
        """
        for key in _OFFSETS:
            if any(exact(word, f"{place}: {key}") for word in _words(block, key)):
                raise InputError(f"{place}: a tilt about a point of its own is not held ({key})")
        kinds = [key for key in _KINDS if key in block.commands]
        if len(kinds) > 1:
            raise InputError(f"{place}: {' and '.join(kinds)} contradict each other")
        self.kind = kinds[0] if kinds else ""
        self.before: Break | None = None
        self.after: Break | None = None
        self.shift_before = self.shift_after = Fraction(0)
        move: Break = {}
        for key, name in _SHIFTS.items():
            value = scaled((_words(block, key) or ["0"])[0], factor, f"{place}: {key}")
            move |= {name: value} if value else {}
        for key, (name, turned) in _TURNS.items():
            value = scaled((_words(block, key) or ["0"])[0], Fraction(1), f"{place}: {key}")
            move |= {name: -value if turned else value} if value else {}
        along = exact((_words(block, "ZDE") or ["0"])[0], f"{place}: ZDE") * factor
        turns = {key: value for key, value in move.items() if key.startswith("tilt")}
        if self.kind != "REV":
            self.before, self.shift_before = _break(move), along
        if self.kind in ("DAR", "REV"):
            self.after = _break({key: -value for key, value in move.items()}, "tilt_first")
            self.shift_after = -along
        if self.kind == "BEN":
            if len(turns) > 1:
                raise InputError(f"{place}: BEN about two axes at once is not held")
            self.after = _break(turns)

    @property
    def is_single(self) -> bool:
        """Return whether there is one break, in front of the surface or behind it."""
        return (self.before is None) != (self.after is None)


def break_words(row: dict[str, Any], place: str) -> list[str]:
    """Return the lines of a dummy surface whose axes, read again, are those of a break.

    Raises:
        InputError: the break's turns are given in radians.
    """
    reverse = row.get("order", "decenter_first") == "tilt_first"
    lines = ["  REV"] if reverse else []
    for key in row:
        if key.endswith("_radians"):
            raise InputError(f"{place}: a .seq file cannot hold '{key}': its angles are in degrees")
    for key, name in _SHIFTS.items():
        if row.get(name):
            lines.append(f"  {key} {_signed(row[name], reverse)}")
    for key, (name, turned) in _TURNS.items():
        if row.get(name):
            lines.append(f"  {key} {_signed(row[name], reverse != turned)}")
    return lines


def _signed(value: object, negative: bool) -> str:
    number = float(value)  # type: ignore[arg-type]
    return repr(-number if negative else number)


def _break(move: Break, order: str | None = None) -> Break | None:
    if not move:
        return None
    return {"type": "coordinate_break", **move, **({"order": order} if order else {})}


def _words(block: Block, key: str) -> list[str]:
    return block.commands[key][-1].words if key in block.commands else []


def summed(first: Fraction, second: Fraction, place: str) -> float:
    """Return the double nearest to the sum of two lengths."""
    return nearest(first + second, place)
