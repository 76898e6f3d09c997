"""A surface of a Zemax `.zmx` file may have tilts and decenters of its own, before and after it.

They are coordinate breaks around it, as Zemax's manual says: `SCBD 1 order 0 x y tx ty tz` in front
of the surface, and `SCBD 2 order status ...` behind it and in front of its thickness.  The order is
0 for a decenter and then tilts about x, y and z, and 1 for tilts about z, y and x and then the
decenter.  Status 1 behind repeats what is in front and 2 undoes it; the numbers are written anyway.
"""

from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.coordinate_break import BREAK, DECENTERS
from dolens.prescriptions.breaks import KIND
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.zemax_block import SurfaceBlock

Break = dict[str, Any]
_BEFORE, _AFTER = "1", "2"
_SAME, _UNDONE = 1, 2


def surface_axes(block: SurfaceBlock) -> tuple[Break, Break]:
    """Return the coordinate breaks before and after a surface; empty where there is none.

    Raises:
        InputError: a number is none, a coordinate break has such axes, or what is behind is not
            what its status says.
    """
    found: dict[str, Break] = {_BEFORE: {}, _AFTER: {}}
    status = 0
    for line in block.lines.get("SCBD", []):
        place = f"{block.place}: SCBD (line {line.at})"
        words = line.arguments
        if not any(number_in_text(word, place) for word in words[3:]):
            continue
        if words[0] not in found or len(words) < 3 + len(BREAK):
            raise InputError(f"{place}: needs 1 or 2, an order, a status, and five numbers")
        if block.type == "COORDBRK":
            raise InputError(f"{place}: a coordinate break with axes of its own is not held")
        row: Break = {"type": KIND}
        for word, name in zip(words[3:], BREAK, strict=False):
            factor = block.factor if name in DECENTERS else 1
            value = scaled(word, factor, place)
            row |= {name: value} if value else {}
        if number_in_text(words[1], place):
            row["order"] = "tilt_first"
        found[words[0]] = row
        status = int(number_in_text(words[2], place)) if words[0] == _AFTER else status
    before, after = found[_BEFORE], found[_AFTER]
    if (status == _SAME and after != before) or (status == _UNDONE and after != _undone(before)):
        raise InputError(
            f"{block.place}: the axes behind the surface are not what they should repeat or undo "
            "(SCBD)"
        )
    return before, after


def _undone(row: Break) -> Break:
    """Return the break that brings back the axes in front of another."""
    back = {key: -value if key in BREAK else value for key, value in row.items() if key != "order"}
    return back if "order" in row else back | {"order": "tilt_first"}
