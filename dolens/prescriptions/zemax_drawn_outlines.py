"""Outlines that a user of Zemax draws are polygons, whose corners stand in the `.zmx` file.

`UDAD 0 name scale` names the `.UDA` file that they were drawn in, and `UDAD n x y angle` gives the
corners in turn.  `0 0` ends a polygon.  An angle other than zero makes a side an arc.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.zemax import Line

# Each is compared with all others.
_MOST_POLYGONS = 1000


def read_polygons(
    block: Mapping[str, list[Line]], factor: Fraction, place: str
) -> list[list[list[float]]]:
    """Return the corners of the polygons of a surface, mm.

    Raises:
        InputError: the corners are in another file, or a side is an arc, or the outline is scaled,
            or polygons lie in one another.
    """
    polygons: list[list[list[float]]] = [[]]
    file = "another file"
    for line in block.get("UDAD", []):
        words, what = line.arguments, f"{place} (line {line.at})"
        if len(words) < 3:
            raise InputError(f"{what}: UDAD needs a number, x and y")
        if number_in_text(words[0], what) == 0:
            file = " ".join(words[1:-1]).strip('"')
            if number_in_text(words[-1], what) != 1.0:
                raise InputError(f"{what}: an outline drawn to another scale is not held")
            continue
        if any(number_in_text(word, what) for word in words[3:]):
            raise InputError(f"{what}: an outline with arcs is not held")
        corner = [scaled(word, factor, what) for word in words[1:3]]
        if any(corner):
            polygons[-1].append(corner)
        else:
            polygons.append([])
    polygons = [_open(polygon) for polygon in polygons if polygon]
    if not polygons:
        raise InputError(f"{place}: the outline that the user draws stands in {file}, not here")
    if any(len(polygon) < 3 for polygon in polygons):
        raise InputError(f"{place}: an outline that the user draws needs three corners at least")
    if len(polygons) > _MOST_POLYGONS:
        raise InputError(
            f"{place}: {len(polygons)} outlines that the user draws (allowed: {_MOST_POLYGONS})"
        )
    _require_apart(polygons, place)
    return polygons


def polygon_lines(polygons: Sequence[Sequence[Sequence[float]]], place: str) -> list[str]:
    """Return the lines that `read_polygons` reads back.

    Raises:
        InputError: a corner at 0, 0, which would end its polygon.
    """
    lines = ['UDAD 0 "OUTLINE.UDA" 1']
    for polygon in polygons:
        for corner in polygon:
            x, y = (as_number(value, place) for value in corner)
            if not (x or y):
                raise InputError(f"{place}: a .zmx file holds no corner of a polygon at 0, 0")
            lines.append(f"UDAD {len(lines)} {x!r} {y!r} 0")
        lines.append(f"UDAD {len(lines)} 0 0 0")
    return lines


def _open(polygon: list[list[float]]) -> list[list[float]]:
    """Return a polygon without a last corner that is the first again."""
    return polygon[:-1] if len(polygon) > 1 and polygon[0] == polygon[-1] else polygon


def _require_apart(polygons: list[list[list[float]]], place: str) -> None:
    """Refuse polygons that may lie in one another, which programs take in different ways."""
    boxes = [
        [(min(values), max(values)) for values in zip(*polygon, strict=True)]
        for polygon in polygons
    ]
    for number, one in enumerate(boxes):
        for other in boxes[:number]:
            if all(a[0] < b[1] and b[0] < a[1] for a, b in zip(one, other, strict=True)):
                raise InputError(f"{place}: outlines that lie in one another are not held")
