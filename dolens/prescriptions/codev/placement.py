"""Axes and apertures of a CODE V surface are read and written.

CODE V moves a surface's axes by XDE, YDE and ZDE and then turns them by ADE about x, BDE about y
and CDE about z; ADE and BDE are left-handed, CDE is right-handed.  Here all turns are right-handed,
in the same order.  What follows keeps these axes; with `DAR` the axes in front come back behind
the surface; with `REV` the move is undone behind the surface and not made in front of it; with
`BEN`, for a mirror, the turn is made once more behind it.

`CIR` is a circle, `REX` and `REY` are half widths of a rectangle, `ELX` and `ELY` semi-axes of an
ellipse; `ADX` and `ADY` move them.  `OBS` behind them makes an obscuration.  `EDG` (a lens's edge)
and `HOL` (a hole) are mechanical: CODE V draws them.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.codev.file import Block
from dolens.prescriptions.numbers import (
    exact,
    nearest,
    number_in_text,
    number_text,
    scaled,
)

_SHIFTS = {"XDE": "decenter_x", "YDE": "decenter_y"}
# Key → prescription's key, and whether the turn has the other sense.
_TURNS = {"ADE": ("tilt_x", True), "BDE": ("tilt_y", True), "CDE": ("tilt_z", False)}
_OFFSETS = ("XOD", "YOD", "ZOD")
_KINDS = ("DAR", "BEN", "REV")

Break = dict[str, Any]
# Commands of an outline → what a prescription calls them.
_OUTLINES: dict[tuple[str, ...], tuple[str, ...]] = {
    ("CIR",): ("semi_diameter",),
    ("REX", "REY"): ("half_width_x", "half_width_y"),
    ("ELX", "ELY"): ("semi_axis_x", "semi_axis_y"),
}
_KEYS = tuple(key for keys in _OUTLINES for key in keys)
_CENTER = {"ADX": "decenter_x", "ADY": "decenter_y"}
_USES = ("CLR", "OBS", "EDG", "HOL")


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
            if any(exact(word, f"{place}: {key}") for word in block.said(key)):
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
            value = scaled((block.said(key) or ["0"])[0], factor, f"{place}: {key}")
            move |= {name: value} if value else {}
        for key, (name, turned) in _TURNS.items():
            value = scaled((block.said(key) or ["0"])[0], Fraction(1), f"{place}: {key}")
            move |= {name: -value if turned else value} if value else {}
        along = exact((block.said("ZDE") or ["0"])[0], f"{place}: ZDE") * factor
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


def summed(first: Fraction, second: Fraction, place: str) -> float:
    """Return the double nearest to the sum of two lengths."""
    return nearest(first + second, place)


def read_apertures(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Read the clear aperture of a surface as a prescription's row has it.

    Returns:
        `semi_diameter` or `aperture`, and `obscuration`.  A mechanical edge alone is
        a semi-diameter that does not clip; without any, the semi-diameter is `auto`.

    Raises:
        InputError: a turned aperture, or two outlines of one use.
    """
    found = _lengths(block, factor, place)
    row: dict[str, Any] = {}
    clear, hole = _outline(found, "CLR", place), _outline(found, "OBS", place)
    if list(clear) == ["semi_diameter"]:
        row |= clear
    elif clear:
        row["aperture"] = clear
    elif "CIR" in found["EDG"]:
        row |= {"semi_diameter": found["EDG"]["CIR"], "clips": False}
    else:
        row["semi_diameter"] = "auto"
    if hole:
        row["obscuration"] = hole
    return row


def has_apertures(block: Block) -> bool:
    """Return whether a surface's block says anything about its size."""
    return any(key in block.commands for key in _KEYS)


def aperture_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines of a surface that `read_apertures` reads back."""
    lines = []
    edge, hole, size = row.get("aperture"), row.get("obscuration"), row.get("semi_diameter")
    if isinstance(hole, list | tuple):
        if len(hole) != 1:
            raise InputError(f"{place}: several obscurations of a surface are not written")
        hole = hole[0]
    if size is not None and size != "auto":
        use = "" if row.get("clips", True) else "EDG "
        lines.append(f"  CIR {use}{number_text(size, place)}")
    return lines + _outline_lines(edge or {}, "", place) + _outline_lines(hole or {}, "OBS ", place)


def _outline_lines(outline: Mapping[str, Any], use: str, place: str) -> list[str]:
    lines = []
    for keys, names in _OUTLINES.items():
        if all(name in outline for name in names):
            lines += [
                f"  {key} {use}{number_text(outline[name], place)}"
                for key, name in zip(keys, names, strict=True)
            ]
    return lines + [
        f"  {key} {use}{number_text(outline[name], place)}"
        for key, name in _CENTER.items()
        if outline.get(name)
    ]


def _lengths(block: Block, factor: Fraction, place: str) -> dict[str, dict[str, float]]:
    """Return use → key → mm."""
    found: dict[str, dict[str, float]] = {use: {} for use in _USES}
    for command in block.commands.get("ARO", []):
        use, words = _use(command.words)
        if use in ("CLR", "OBS") and any(number_in_text(w, f"{place}: ARO") for w in words):
            raise InputError(f"{place}: a turned aperture is not held (ARO)")
    for key in (*_KEYS, *_CENTER):
        for command in block.commands.get(key, []):
            use, words = _use(command.words)
            what = f"{place}: {key} (line {command.at})"
            if len(words) != 1:
                raise InputError(f"{what} needs one number")
            if use in ("CLR", "OBS") and key in found[use]:
                raise InputError(f"{what}: a second aperture of one kind is not held")
            found[use][key] = scaled(words[0], factor, what)
    return found


def _use(words: list[str]) -> tuple[str, list[str]]:
    """Take the use and the label (L'A') from the arguments of an aperture's command."""
    use = next((word.upper() for word in words if word.upper() in _USES), "CLR")
    rest = [w for w in words if w.upper() not in _USES and w[:2].upper() not in ("L'", 'L"')]
    return use, rest


def _outline(found: dict[str, dict[str, float]], use: str, place: str) -> dict[str, float]:
    """Return the outline of a use as a prescription has it; empty where there is none."""
    lengths = found[use]
    given = [keys for keys in _OUTLINES if any(key in lengths for key in keys)]
    if len(given) > 1:
        names = " and ".join(keys[0] for keys in given)
        raise InputError(f"{place}: an aperture of two outlines is not held ({names})")
    if not given:
        return {}
    for key in given[0]:
        if key not in lengths:
            raise InputError(f"{place}: the aperture needs {' and '.join(given[0])}")
    outline = {n: lengths[key] for key, n in zip(given[0], _OUTLINES[given[0]], strict=True)}
    return outline | {name: lengths[key] for key, name in _CENTER.items() if lengths.get(key)}
