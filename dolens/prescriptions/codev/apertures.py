"""Apertures of a CODE V surface: circles and rectangles that clip, block, or are only drawn.

`CIR` is a circle, `REX` and `REY` are the half widths of a rectangle; `OBS` behind them makes an
obscuration.  `EDG` (a lens's edge) and `HOL` (a hole) are mechanical: CODE V draws them.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.codev.file import Block
from dolens.prescriptions.decimals import number_in_text, scaled

_KEYS = ("CIR", "REX", "REY")
_MOVED = {"ADX": "a decentred aperture", "ADY": "a decentred aperture", "ARO": "a turned aperture"}
_USES = ("CLR", "OBS", "EDG", "HOL")
_HALF_WIDTHS = ("half_width_x", "half_width_y")


def read_apertures(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Read the clear aperture of a surface as a prescription's row has it.

    Returns:
        `semi_diameter` or `aperture`, and `obscuration`.  A mechanical edge alone is
        a semi-diameter that does not clip; without any, the semi-diameter is `auto`.

    Raises:
        InputError: an ellipse, a decentred aperture, or two shapes of one use.
    """
    found = _lengths(block, factor, place)
    row: dict[str, Any] = {}
    clear, hole = _outline(found, "CLR", place), _outline(found, "OBS", place)
    if "semi_diameter" in clear:
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
    return any(key in block.commands for key in (*_KEYS, "ELX", "ELY"))


def aperture_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines of a surface that `read_apertures` reads back."""
    lines = []
    edge, hole, size = row.get("aperture"), row.get("obscuration"), row.get("semi_diameter")
    if size is not None and size != "auto":
        use = "" if row.get("clips", True) else "EDG "
        lines.append(f"  CIR {use}{_text(size, place)}")
    if edge and all(key in edge for key in _HALF_WIDTHS):
        x, y = (_text(edge[key], place) for key in _HALF_WIDTHS)
        lines.append(f"  REX {x}; REY {y}")
    if hole and "semi_diameter" in hole:
        lines.append(f"  CIR OBS {_text(hole['semi_diameter'], place)}")
    elif hole and all(key in hole for key in _HALF_WIDTHS):
        x, y = (_text(hole[key], place) for key in _HALF_WIDTHS)
        lines.append(f"  REX OBS {x}; REY OBS {y}")
    return lines


def _lengths(block: Block, factor: Fraction, place: str) -> dict[str, dict[str, float]]:
    """Return use → key → mm."""
    found: dict[str, dict[str, float]] = {use: {} for use in _USES}
    for key in ("ELX", "ELY"):
        if key in block.commands:
            raise InputError(f"{place}: an elliptical aperture is not held ({key})")
    for key, what in _MOVED.items():
        for command in block.commands.get(key, []):
            use, words = _use(command.words)
            if use in ("CLR", "OBS") and any(number_in_text(w, f"{place}: {key}") for w in words):
                raise InputError(f"{place}: {what} is not held ({key})")
    for key in _KEYS:
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
    lengths = found[use]
    if "CIR" in lengths and len(lengths) > 1:
        raise InputError(f"{place}: a circle cut by a rectangle is not held (CIR, REX, REY)")
    if "CIR" in lengths:
        return {"semi_diameter": lengths["CIR"]}
    if len(lengths) == 1:
        raise InputError(f"{place}: a rectangular aperture needs REX and REY")
    return dict(zip(_HALF_WIDTHS, (lengths["REX"], lengths["REY"]), strict=True)) if lengths else {}


def _text(value: object, place: str) -> str:
    return repr(as_number(value, place))
