"""TYPE TILTSURF of a Zemax `.zmx` file is the plane z = x·tan θx + y·tan θy (PARM 1 and 2)."""

from collections.abc import Mapping
from typing import Any

from dolens.prescriptions.zemax.file import SurfaceBlock
from dolens.prescriptions.zemax_shape import Row, ZemaxShape


def _read(block: SurfaceBlock) -> Row:
    """Return a polynomial of the first degree; its medium bends rays as that of any surface."""
    return {"type": "xy_polynomial", "x": block.parameter(1), "y": block.parameter(2)}


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    """Return nothing: the polynomial is written as TYPE XPOLYNOM, which can hold more of them."""
    return []


TILTED_PLANE = ZemaxShape("TILTSURF", (), _read, _write, parameters=(1, 2))
