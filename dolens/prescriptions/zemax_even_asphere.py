"""TYPE EVENASPH of a Zemax `.zmx` file is a conic plus powers of r² (PARM 1 to 8: r² to r¹⁶).

Other programs write further powers in the same way; they are read, and not written.
"""

import re
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import conic_line, curvature_line

_COEFFICIENTS = 8
_POWER = re.compile(r"a(\d+)")


def _read(block: SurfaceBlock) -> Row:
    """Return the coefficients that the file lists.

    Programs list all eight, or more, used or not: then the zeros behind the last that is used are
    left out.
    """
    found = {f"a{2 * n}": block.parameter(n, 1 - 2 * n) for n in sorted(block.parameters) if n}
    if len(found) >= _COEFFICIENTS:
        used = max((int(name[1:]) for name, value in found.items() if value), default=0)
        found = {name: value for name, value in found.items() if int(name[1:]) <= used}
    if found.get("a2") == 0.0 and block.parameters[1] != NAMED_ZERO:
        del found["a2"]
    row = curvature_row(block.curvature)
    return {"type": "even_asphere", **row, "conic": block.number("CONI"), **found}


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    lines = [curvature_line(row, place), conic_line(row, place)]
    for key in row:
        power = _POWER.fullmatch(key)
        if power:
            n = int(power[1])
            if n % 2 or not 2 <= n <= 2 * _COEFFICIENTS:
                raise InputError(f"{place}: a .zmx file cannot hold '{key}' (allowed: a2 to a16)")
            lines.append(f"PARM {n // 2} {as_number(row[key], place) or float(NAMED_ZERO)!r}")
    return lines


EVEN_ASPHERE = ZemaxShape(
    "EVENASPH", ("even_asphere",), _read, _write, parameters=range(1, 2 * _COEFFICIENTS + 1)
)
