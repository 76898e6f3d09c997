"""Apertures of a Zemax surface are circles, rings, rectangles, and obscurations.

`CLAP` and `FLAP` are circles (the first may have an inner radius, an obscuration), `SQAP` is a
rectangle of half widths, `OBSC` and `SQOB` block a circle and a rectangle.  A surface has one of
them; `DIAM` is the semi-diameter it is drawn to.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.zemax import Line

Block = dict[str, list[Line]]

_NOT_HELD = {
    "SPID": "a spider, which blocks light with its arms,",
    "USAP": "an aperture whose outline the user draws",
    "USOB": "an obscuration whose outline the user draws",
    "ELAP": "an elliptical aperture",
    "ELOB": "an elliptical obscuration",
}
_HALF_WIDTHS = ("half_width_x", "half_width_y")


def read_apertures(block: Block, factor: Fraction, place: str) -> tuple[dict[str, Any], bool]:
    """Read the clear aperture of a surface's block.

    Args:
        block: its lines by operand.
        factor: mm in a unit of the file.
        place: name in messages.

    Returns:
        `semi_diameter` or `aperture`, and `obscuration`, as a prescription's row has them (nothing
        where the file gives no size), and whether Zemax clips there.

    Raises:
        InputError: a decentred aperture, a floating one with a hole, or an obscuring ring.
    """
    for operand, what in _NOT_HELD.items():
        if operand in block:
            raise InputError(f"{place}: {what} is not held ({operand})")
    if any(number_in_text(word, f"{place}: OBDC") for word in _words(block, "OBDC")[:2]):
        raise InputError(f"{place}: OBDC, a decentred aperture, is not held")
    drawn = scaled((_words(block, "DIAM") or ["0"])[0], factor, f"{place}: DIAM")
    found = {"semi_diameter": drawn} if drawn else {}
    if "SQAP" in block:
        return {
            "aperture": dict(zip(_HALF_WIDTHS, _pair(block, "SQAP", factor, place), strict=True))
        }, True
    if "CLAP" in block:
        inner, outer = _pair(block, "CLAP", factor, place)
        hole = {"obscuration": {"semi_diameter": inner}} if inner else {}
        return {"semi_diameter": outer, **hole}, True
    if "OBSC" in block:
        inner, outer = _pair(block, "OBSC", factor, place)
        if inner:
            raise InputError(f"{place}: OBSC must be a full circle, 'OBSC 0 radius'")
        return found | {"obscuration": {"semi_diameter": outer}}, True
    if "SQOB" in block:
        sides = zip(_HALF_WIDTHS, _pair(block, "SQOB", factor, place), strict=True)
        return found | {"obscuration": dict(sides)}, True
    if "FLAP" in block:
        inner, outer = _pair(block, "FLAP", factor, place)
        if inner:
            raise InputError(f"{place}: FLAP must be a full circle, 'FLAP 0 radius'")
        return found or {"semi_diameter": outer}, is_fixed(block)
    return found, False


def aperture_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines of a surface's block that `read_apertures` reads back.

    What one Zemax aperture cannot say (a rectangle with a hole) does not come back, and is refused
    by the writer's comparison.
    """
    semi_diameter, edge = row.get("semi_diameter"), row.get("aperture") or {}
    hole = row.get("obscuration") or {}
    if semi_diameter is None:
        if not all(key in edge for key in _HALF_WIDTHS):
            return []
        x, y = (_text(edge[key], place) for key in _HALF_WIDTHS)
        return [f'  DIAM {max(float(x), float(y))!r} 1 0 0 1 ""', f"  SQAP {x} {y}"]
    size = _text(semi_diameter, place)
    lines = [f'  DIAM {size} 1 0 0 1 ""']
    if all(key in hole for key in _HALF_WIDTHS):
        x, y = (_text(hole[key], place) for key in _HALF_WIDTHS)
        return [*lines, f"  SQOB {x} {y}"]
    return [*lines, f"  CLAP {_text(hole.get('semi_diameter', 0), place)} {size} 0"]


def is_fixed(block: Block) -> bool:
    """Return whether a surface's DIAM is the user's own and not computed."""
    return _words(block, "DIAM")[1:2] == ["1"]


def _pair(block: Block, operand: str, factor: Fraction, place: str) -> tuple[float, float]:
    words = _words(block, operand)
    if len(words) < 2:
        raise InputError(f"{place}: {operand} needs two numbers")
    first, second = (scaled(word, factor, f"{place}: {operand}") for word in words[:2])
    return first, second


def _words(block: Block, operand: str) -> list[str]:
    return block[operand][-1].arguments if operand in block else []


def _text(value: object, place: str) -> str:
    number = as_number(value, place)
    return repr(number) if number else "0"
