"""GRID_SAG of a Zemax `.zmx` file adds a grid of sags to an even asphere.

GDAT has the numbers of columns and rows, and their spacings; `GARR n sag slope slope twist flag` is
a node, row after row from +y to -y, and within a row from -x to +x.  Where all slopes are zero they
are not given, and come from splines.  PARM 0, 1 for linear interpolation, the grid's decentre and
Zernike polynomials are not held.
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number, number_in_text, scaled
from dolens.prescriptions.zemax.file import SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_polynomials import named, power_lines
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import conic_line, curvature_line

_POWERS = 8
_ARRAYS = ("sag", "slope_x", "slope_y", "twist")
# Powers of a length that a node's numbers are.
_UNITS = (1, 0, 0, -1)


def _read(block: SurfaceBlock) -> Row:
    if block.parameter(0) != 0.0:
        raise InputError(f"{block.place}: linear interpolation of a grid is not held (PARM 0)")
    for n, word in block.extra_data.items():
        if n >= 3 and float(word) != 0.0:
            raise InputError(
                f"{block.place}: Zernike polynomials on a grid are not held (XDAT {n}: {word})"
            )
    columns, rows, spacings = _size(block)
    given = block.lines.get("GARR", [])
    if columns * rows > len(given):
        raise InputError(
            f"{block.place}: GDAT names {columns:.6g} × {rows:.6g} nodes, and {len(given)} have a "
            "GARR"
        )
    nodes: list[list[float] | None] = [None] * (columns * rows)
    for line in given:
        what = f"{block.place}: GARR (line {line.at})"
        if len(line.arguments) < 5:
            raise InputError(f"{what}: needs a number, sag, two slopes and the twist")
        node = number_in_text(line.arguments[0], what)
        if not 0 <= node < len(nodes) or node != int(node):
            raise InputError(f"{what}: must be a node from 0 to {len(nodes) - 1}, not {node:g}")
        if any(float(word) != 0.0 for word in line.arguments[5:6]):
            raise InputError(f"{what}: node {node:g} has no data, which is not held")
        words = zip(line.arguments[1:5], _UNITS, strict=True)
        nodes[int(node)] = [scaled(word, block.factor**power, what) for word, power in words]
    missing = sum(numbers is None for numbers in nodes)
    if missing:
        raise InputError(f"{block.place}: {missing} of {len(nodes)} nodes have no GARR")
    row = {"type": "grid_sag", **curvature_row(block.curvature), "conic": block.number("CONI")}
    for n in range(1, _POWERS + 1):
        if named(block.parameters.get(n, "0")):
            row[f"a{2 * n}"] = block.parameter(n, 1 - 2 * n)
    row |= spacings
    sloped = any(any(node[1:]) for node in nodes if node)
    for place, name in enumerate(_ARRAYS if sloped else _ARRAYS[:1]):
        array = [
            [node[place] for node in nodes[columns * j : columns * (j + 1)] if node]
            for j in reversed(range(rows))
        ]
        row[name] = array
    return row


def _size(block: SurfaceBlock) -> tuple[int, int, dict[str, float]]:
    """Return numbers of columns and rows, and the spacings (mm) by name."""
    what = f"{block.place}: GDAT"
    words = block.words("GDAT")
    if len(words) < 4:
        raise InputError(f"{what}: needs columns, rows and two spacings")
    columns, rows = (number_in_text(word, what) for word in words[:2])
    if min(columns, rows) < 2 or columns != int(columns) or rows != int(rows):
        raise InputError(f"{what}: needs 2 or more columns and rows, not {words[0]} × {words[1]}")
    if any(number_in_text(word, what) != 0.0 for word in words[4:6]):
        raise InputError(f"{what}: a grid that is decentred is not held")
    names = ("spacing_x", "spacing_y")
    spacings = {
        name: scaled(word, block.factor, what) for name, word in zip(names, words[2:4], strict=True)
    }
    return int(columns), int(rows), spacings


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    lines = [curvature_line(row, place), conic_line(row, place)]
    lines += power_lines(row, place, 2, 2 * _POWERS, lambda power: power // 2)
    sag = row["sag"]
    sizes = [as_number(row.get(name), place) for name in ("spacing_x", "spacing_y")]
    lines.append(f"GDAT {len(sag[0])} {len(sag)} {sizes[0]!r} {sizes[1]!r} 0 0")
    arrays = [row.get(name) for name in _ARRAYS]
    n = 0
    for j in reversed(range(len(sag))):
        for i in range(len(sag[0])):
            numbers = [0.0 if a is None else as_number(a[j][i], place) for a in arrays]
            lines.append(f"GARR {n} {' '.join(map(repr, numbers))} 0")
            n += 1
    return lines


GRID_SAG = ZemaxShape(
    "GRID_SAG",
    ("grid_sag",),
    _read,
    _write,
    parameters=range(_POWERS + 3),
    extra_data=None,
)
