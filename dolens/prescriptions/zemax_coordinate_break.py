"""TYPE COORDBRK of a Zemax `.zmx` file is a coordinate break.

PARM 1 and 2 are decenters in x and y, 3 to 5 tilts about x, y and z in degrees, right-handed: for
PARM 6 = 0 the axes are decentred and then turned about x, the new y and the new z; for any other
PARM 6 they are turned about z, y and x first.  A break that returns to an earlier surface (SCBD)
has the numbers in PARM and DISZ that Zemax found for it.

What tells the sense of rotation: Handbook of Optics, vol. II, ch. 18, no. 46 as a Zemax file has a
mirror tilted by -3.32° about x (PARM 3) and 206.8 mm behind it an image decentred by +24.0739 mm in
y; and a file that returns by SCBD to axes from which it was turned by PARM 4 = -45 has Zemax's own
decenter and thickness, +14.64 and -35.36 mm, for the way back.
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.optics.elements import TILTS
from dolens.optics.surfaces.coordinate_break import BREAK, DECENTERS
from dolens.prescriptions.numbers import as_number
from dolens.prescriptions.row_data import BREAK_KIND
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock
from dolens.prescriptions.zemax_shape import Row, ZemaxShape

_ORDER = 6


def _read(block: SurfaceBlock) -> Row:
    """Return the numbers that are not zero, and those that a writer named."""
    if block.words("GLAS"):
        raise InputError(f"{block.place}: a coordinate break with a medium (GLAS) is not held")
    row: Row = {"type": BREAK_KIND}
    for n, name in enumerate(BREAK, 1):
        value = block.parameter(n, 1 if name in DECENTERS else 0)
        if value or block.parameters.get(n) == NAMED_ZERO:
            row[name] = value
    if block.parameter(_ORDER):
        row["order"] = "tilt_first"
    return row


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    for name in TILTS:
        if f"{name}_radians" in row:
            raise InputError(
                f"{place}: a .zmx file cannot hold '{name}_radians': no number of degrees means "
                "this angle to the last bit; round it to '" + name + "'"
            )
    lines = []
    for n, name in enumerate(BREAK, 1):
        value = as_number(row.get(name, 0.0), f"{place}: '{name}'")
        named = value or (float(NAMED_ZERO) if name in row else 0)
        lines.append(f"PARM {n} {named!r}")
    return [*lines, f"PARM {_ORDER} {int(row.get('order') == 'tilt_first')}"]


COORDINATE_BREAK = ZemaxShape(
    "COORDBRK", (BREAK_KIND,), _read, _write, parameters=None, extra_data=None, surface=False
)
