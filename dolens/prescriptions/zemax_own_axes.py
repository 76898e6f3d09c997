"""A surface of a Zemax `.zmx` file may have decenters and tilts of its own, before and after it.

They are a coordinate break in front of the surface, and another between it and its thickness::

    SCBD 1 order 0 dx dy tx ty tz       # before the surface
    SCBD 2 order status dx dy tx ty tz  # after it

As of a break, order 0 decentres and then turns about x, y and z, any other turns about z, y and x
first.  The status says where the numbers after the surface come from: 0 they are its own, 1 they
are those before it, 2 those undo them, with their signs and the order reversed; from 3 on they are
those of another surface.  Zemax writes the resulting numbers in each case.  SCBD 3 says of a
coordinate break that it returns to an earlier surface, and its numbers stand in PARM.

Source: OpticStudio's help, "Tilt/Decenter" (surface properties).  Files agree: a fold mirror of 45°
has the same 45° after it with status 1, and a surface turned by 90° about z, -90° with status 2 and
the other order.
"""

from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.coordinate_break import BREAK, DECENTERS
from dolens.prescriptions.breaks import KIND
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.zemax_block import SurfaceBlock

Row = dict[str, Any]

_BEFORE, _AFTER, _RETURN = "1", "2", "3"
_SAME, _REVERSED = 1.0, 2.0
# Behind the kind: order and status.
_NUMBERS = 3


def own_axes(block: SurfaceBlock) -> tuple[Row | None, Row | None]:
    """Return the rows of the breaks before and after a surface, None where nothing moves.

    Raises:
        InputError: a coordinate break has any, or the numbers after a surface are not those that
            its status says.
    """
    before, after, status = None, None, 0.0
    for line in block.lines.get("SCBD", []):
        place = f"{block.place}: SCBD (line {line.at})"
        kind = (line.arguments or [""])[0]
        if kind == _RETURN:
            continue
        row = _row(block, line.arguments, place)
        if kind == _BEFORE:
            before = row
        elif kind == _AFTER:
            after = row
            status = number_in_text((*line.arguments, "0", "0", "0")[2], place)
        elif row is not None:
            raise InputError(f"{place}: kind {kind} is not known (allowed: 1, 2, 3)")
    if block.type == "COORDBRK" and (before or after):
        raise InputError(f"{block.place}: a coordinate break with axes of its own is not held")
    sign = {_SAME: 1.0, _REVERSED: -1.0}.get(status)
    if sign and _numbers(after) != {n: sign * v for n, v in _numbers(before).items()}:
        raise InputError(
            f"{block.place}: SCBD: the tilts and decenters after the surface are not those before "
            f"it{', reversed' if status == _REVERSED else ''}, as the file says they are"
        )
    return before, after


def _row(block: SurfaceBlock, words: list[str], place: str) -> Row | None:
    """Return the numbers of a break that are not zero; None where all are."""
    row: Row = {"type": KIND}
    for name, word in zip(BREAK, words[_NUMBERS:], strict=False):
        value = (
            scaled(word, block.factor, place) if name in DECENTERS else number_in_text(word, place)
        )
        if value:
            row[name] = value
    if len(row) == 1:
        return None
    if number_in_text((*words, "0", "0")[1], place):
        row["order"] = "tilt_first"
    return row


def _numbers(row: Row | None) -> dict[str, float]:
    return {name: row[name] for name in BREAK if name in row} if row else {}
