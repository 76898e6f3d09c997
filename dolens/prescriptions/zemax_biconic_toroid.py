"""Biconics and toroids in a Zemax `.zmx` file: CURV and CONI are those along y.

BICONICX has PARM 1 and 2, radius and conic constant along x.  TOROIDAL has PARM 1, the radius of
rotation, and PARM 2 to 8, the coefficients of y² to y¹⁴; its Zernike polynomials (XDAT) are
not held, and PARM 0 is about these alone.  A radius of 0 means infinity in both.
"""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number, curvature_in_text, reciprocal
from dolens.prescriptions.zemax.file import SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_polynomials import named, power_lines
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import conic_line, curvature_line

_TOROID_TERMS = 7


def _along_x(block: SurfaceBlock) -> dict[str, float]:
    """Return radius or curvature along x."""
    radius = block.parameter(1, 1)
    if radius == 0.0:
        return {"radius_x": math.inf}
    # A radius with more digits than a double was written for its curvature's sake.
    curvature = curvature_in_text(block.parameters[1], f"{block.place}: PARM 1")
    if curvature is not None and block.factor == 1:
        return {"curvature_x": curvature}
    return {"radius_x": radius}


def _along_y(block: SurfaceBlock) -> dict[str, float]:
    """Return radius or curvature along y."""
    row = curvature_row(block.curvature)
    return {f"{key}_y": value for key, value in row.items()}


def _curve_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines of radius and conic constant along y, and of the radius along x."""
    along_y = {key: row[f"{key}_y"] for key in ("radius", "curvature", "conic")
               if f"{key}_y" in row}  # fmt: skip
    if row.get("curvature_x") is not None:
        curvature = as_number(row["curvature_x"], f"{place}: 'curvature_x'")
        word = reciprocal(curvature) if curvature else "0"
    else:
        radius = as_number(row.get("radius_x"), f"{place}: 'radius_x'", finite=False)
        word = "0" if math.isinf(radius) else repr(radius)
    return [curvature_line(along_y, place), conic_line(along_y, place), f"PARM 1 {word}"]


def _read_biconic(block: SurfaceBlock) -> Row:
    conics = {"conic_x": block.parameter(2), "conic_y": block.number("CONI")}
    return {"type": "biconic", **_along_x(block), **_along_y(block), **conics}


def _write_biconic(row: Mapping[str, Any], place: str) -> list[str]:
    lines = _curve_lines(row, place)
    return [*lines, f"PARM 2 {as_number(row.get('conic_x', 0.0), place)!r}"]


def _read_toroid(block: SurfaceBlock) -> Row:
    for n, word in block.extra_data.items():
        if n >= 3 and float(word) != 0.0:
            raise InputError(
                f"{block.place}: Zernike polynomials on a toroid are not held (XDAT {n}: {word})"
            )
    terms = {
        f"a{2 * (n - 1)}": block.parameter(n, 3 - 2 * n)
        for n in range(2, _TOROID_TERMS + 2)
        if named(block.parameters.get(n, "0"))
    }
    row = {"type": "toroid", **_along_x(block), **_along_y(block)}
    return row | {"conic_y": block.number("CONI"), **terms}


def _write_toroid(row: Mapping[str, Any], place: str) -> list[str]:
    powers = power_lines(row, place, 2, 2 * _TOROID_TERMS, lambda power: power // 2 + 1)
    return [*_curve_lines(row, place), *powers]


BICONIC = ZemaxShape("BICONICX", ("biconic",), _read_biconic, _write_biconic, parameters=(1, 2))
TOROID = ZemaxShape(
    "TOROIDAL",
    ("toroid",),
    _read_toroid,
    _write_toroid,
    parameters=range(_TOROID_TERMS + 2),
    extra_data=None,
)
