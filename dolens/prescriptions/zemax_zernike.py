"""SZERNSAG and FZERNSAG of a Zemax `.zmx` file add Zernike polynomials to an even asphere.

PARM 1 to 8 are the coefficients of r² to r¹⁶, PARM 9 and 10 the decentre of the polynomials, and
PARM 0 says whether these go on beyond the normalisation radius.  XDAT 1 is the number of terms,
XDAT 2 the normalisation radius, and from XDAT 3 on come the coefficients, in lengths.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.zernike import ZernikeFringe, ZernikeSag, ZernikeStandard
from dolens.prescriptions.numbers import as_number
from dolens.prescriptions.zemax.file import SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_polynomials import (
    named,
    number_of_terms,
    positive_extra,
    power_lines,
    text,
)
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import conic_line, curvature_line

_POWERS = 8
_TERM = re.compile(r"z([1-9]\d*)")


def _reader(shape: type[ZernikeSag]) -> Callable[[SurfaceBlock], Row]:
    def read(block: SurfaceBlock) -> Row:
        row = {"type": shape.kind, **curvature_row(block.curvature), "conic": block.number("CONI")}
        for n in range(1, _POWERS + 1):
            if named(block.parameters.get(n, "0")):
                row[f"a{2 * n}"] = block.parameter(n, 1 - 2 * n)
        count = number_of_terms(block, 1, shape.terms)
        positive_extra(block, 2, "the normalization radius")
        row["normalization_radius"] = block.extra(2, 1)
        for n, axis in ((9, "x"), (10, "y")):
            if named(block.parameters.get(n, "0")):
                row[f"decenter_{axis}"] = block.parameter(n, 1)
        _require_inside(block, row)
        for n in range(1, count + 1):
            if named(block.extra_data.get(n + 2, "0")):
                row[f"z{n}"] = block.extra(n + 2, 1)
        return row

    return read


def _require_inside(block: SurfaceBlock, row: Row) -> None:
    """Refuse polynomials that end within the aperture, where `Extrapolate` (PARM 0) is 0."""
    reach = block.length("DIAM") + math.hypot(block.parameter(9, 1), block.parameter(10, 1))
    radius = row["normalization_radius"]
    if block.parameter(0) == 0.0 and reach > radius * (1.0 + 1e-9):
        raise InputError(
            f"{block.place}: the aperture reaches {reach:g} mm from the centre of the Zernike "
            f"polynomials, which end at {radius:g} mm (XDAT 2) as PARM 0 (extrapolate) is 0"
        )


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    lines = [curvature_line(row, place), conic_line(row, place)]
    lines += power_lines(row, place, 2, 2 * _POWERS, lambda power: power // 2)
    lines += [
        f"PARM {n} {text(row[key], place)}"
        for n, key in ((9, "decenter_x"), (10, "decenter_y"))
        if key in row
    ]
    lines.append("PARM 0 1")
    terms = {int(m[1]): value for key, value in row.items() if (m := _TERM.fullmatch(key))}
    lines += [
        f"XDAT 1 {max(terms, default=0)}",
        f"XDAT 2 {as_number(row.get('normalization_radius'), place)!r}",
    ]
    return lines + [f"XDAT {n + 2} {text(value, place)}" for n, value in sorted(terms.items())]


def _shape(zemax_type: str, shape: type[ZernikeSag]) -> ZemaxShape:
    return ZemaxShape(
        zemax_type,
        (shape.kind,),
        _reader(shape),
        _write,
        parameters=range(_POWERS + 3),
        extra_data=range(1, shape.terms + 3),
    )


ZERNIKE_STANDARD = _shape("SZERNSAG", ZernikeStandard)
ZERNIKE_FRINGE = _shape("FZERNSAG", ZernikeFringe)
