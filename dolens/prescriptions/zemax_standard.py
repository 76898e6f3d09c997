"""TYPE STANDARD of a Zemax `.zmx` file is a plane, a sphere or a conic."""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number
from dolens.prescriptions.zemax.file import SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_shape import Row, ZemaxShape


def _read(block: SurfaceBlock) -> Row:
    """Return a conic where CONI is given; a plane where CURV is `0`, without a decimal point.

    Zemax itself writes 0.0, and that is a curvature that an optimizer may change, but for the stop
    in one medium, which is an aperture.
    """
    curvature = block.curvature
    if "CONI" in block.lines:
        return {"type": "conic", **curvature_row(curvature), "conic": block.number("CONI")}
    if curvature == 0.0 and block.stop and block.material == block.before:
        return {"type": "aperture"}
    if (block.words("CURV") or ["0"])[0] == "0":
        return {"type": "plane"}
    return {"type": "sphere", **curvature_row(curvature)}


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    kind = str(row.get("type", "sphere"))
    if kind in ("plane", "aperture"):
        return ["CURV 0"]
    lines = [curvature_line(row, place)]
    return [*lines, conic_line(row, place)] if kind == "conic" else lines


def curvature_line(row: Mapping[str, Any], place: str) -> str:
    """Return the line of a row's `radius` or `curvature`."""
    if row.get("curvature") is not None:
        curvature = as_number(row["curvature"], f"{place}: 'curvature'")
    else:
        radius = as_number(row.get("radius", math.inf), f"{place}: 'radius'", finite=False)
        if radius == 0.0:
            raise InputError(f"{place}: 'radius' is 0; write .inf for a plane")
        curvature = 1.0 / radius
    return f'CURV {curvature!r} 0 0 0 0 ""'


def conic_line(row: Mapping[str, Any], place: str) -> str:
    """Return the line of a row's `conic`."""
    return f"CONI {as_number(row.get('conic', 0.0), place)!r}"


# Numbers of PARM that an earlier TYPE left behind mean nothing here.
STANDARD = ZemaxShape(
    "STANDARD",
    ("plane", "aperture", "sphere", "conic"),
    _read,
    _write,
    parameters=None,
    extra_data=None,
)
# A polarizer or retarder: its eight numbers change the light's polarization and bend no ray.  Its
# plane is written as any other.
JONES_MATRIX = ZemaxShape("JONESMAT", (), _read, _write, parameters=range(1, 9))
