"""Apertures of a Zemax surface are circles, rings, rectangles, ellipses, polygons, obscurations.

`CLAP` and `FLAP` are circles (which may have an inner radius, an obscuration), `SQAP` is a
rectangle of half widths, `ELAP` an ellipse; `OBSC`, `SQOB` and `ELOB` block such outlines, and
`OBSC` with an inner radius blocks a ring.  `SPID` is a spider: the width of its arms and their
number, the first along +x.  `USAP` and `USOB` are outlines that the user draws, whose corners
`UDAD` lists.  A surface has one of them, and `OBDC` says where it is
beside the vertex.

`DIAM` is the semi-diameter that a surface is drawn to, and clips nothing, whether a user or Zemax
has written it.  `DIAM 0`, or none, leaves the size to the light of the fields.

`UDAD 0 name scale` names the `.UDA` file that they were drawn in, and `UDAD n x y angle` gives the
corners in turn.  `0 0` ends a polygon.  An angle other than zero makes a side an arc.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.apertures import AUTOMATIC
from dolens.prescriptions.numbers import as_number, number_in_text, scaled
from dolens.prescriptions.zemax.file import Line

Block = Mapping[str, list[Line]]

_HALF_WIDTHS = ("half_width_x", "half_width_y")
_SEMI_AXES = ("semi_axis_x", "semi_axis_y")
_CENTER = ("decenter_x", "decenter_y")
# A circle of this radius, mm, has no edge: Zemax's 1E+10 stands for infinity.
_NO_EDGE = 1e9
# Outlines of two numbers: what light passes, and what blocks it.
_PASSED = {"SQAP": _HALF_WIDTHS, "ELAP": _SEMI_AXES}
_BLOCKED = {"SQOB": _HALF_WIDTHS, "ELOB": _SEMI_AXES}
# Each is compared with all others.
_MOST_POLYGONS = 1000


def read_apertures(
    block: Block, factor: Fraction, place: str, stop: bool = False
) -> tuple[dict[str, Any], bool]:
    """Read the clear aperture of a surface's block.

    Args:
        block: its lines by operand.
        factor: mm in a unit of the file.
        place: name in messages.
        stop: whether the surface is the stop, whose DIAM may define the pupil.

    Returns:
        `semi_diameter`, `clips`, `aperture` and `obscuration`, as a prescription's row has them,
        and whether the surface stops light in Zemax.  Of the stop the semi-diameter clips always.

    Raises:
        InputError: an outline that a prescription does not hold.
    """
    center = [scaled(word, factor, f"{place}: OBDC") for word in _words(block, "OBDC")[:2]]
    beside = {key: value for key, value in zip(_CENTER, center, strict=False) if value}
    drawn = scaled((_words(block, "DIAM") or ["0"])[0], factor, f"{place}: DIAM")
    drawn = abs(drawn)
    found: dict[str, Any] = {"semi_diameter": drawn} if drawn else {}
    if not stop:
        found = found | {"clips": False} if drawn else {"semi_diameter": AUTOMATIC}
    for operand, keys in _PASSED.items():
        if operand in block:
            sides = dict(zip(keys, _pair(block, operand, factor, place), strict=True))
            return (found if stop else {}) | {"aperture": sides | beside}, True
    if "CLAP" in block:
        inner, outer = _pair(block, "CLAP", factor, place)
        hole = {"obscuration": {"semi_diameter": inner}} if inner else {}
        if outer >= _NO_EDGE:
            return found | (
                {"obscuration": hole["obscuration"] | beside} if hole else {}
            ), inner > 0
        if beside:
            outline = {"aperture": {"semi_diameter": outer} | beside}
            return (found if stop else {}) | outline | hole, True
        return {"semi_diameter": min(outer, drawn or outer) if stop else outer, **hole}, True
    if "OBSC" in block:
        inner, outer = _pair(block, "OBSC", factor, place)
        ring = {"inner_semi_diameter": inner} if inner else {}
        hole = {"obscuration": {**ring, "semi_diameter": outer} | beside} if outer else {}
        return found | hole, True
    if "SPID" in block:
        return found | {"obscuration": _spider(block, factor, place) | beside}, True
    if "USAP" in block:
        drawn_by_user = {"polygons": _read_polygons(block, factor, f"{place}: USAP")}
        return (found if stop else {}) | {"aperture": drawn_by_user | beside}, True
    if "USOB" in block:
        drawn_by_user = {"polygons": _read_polygons(block, factor, f"{place}: USOB")}
        return found | {"obscuration": drawn_by_user | beside}, True
    for operand, keys in _BLOCKED.items():
        if operand in block:
            sides = dict(zip(keys, _pair(block, operand, factor, place), strict=True))
            return found | {"obscuration": sides | beside}, True
    if "FLAP" in block:
        # A floating aperture is as large as the semi-diameter: an automatic one passes all light.
        inner, outer = _pair(block, "FLAP", factor, place)
        hole = {"obscuration": {"semi_diameter": inner} | beside} if inner else {}
        if is_fixed(block) and (drawn or outer):
            if beside:
                outline = {"aperture": {"semi_diameter": drawn or outer} | beside}
                return (found if stop else {}) | outline | hole, True
            return {"semi_diameter": drawn or outer} | hole, True
        return found | hole, bool(hole)
    return found, False


def aperture_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines of a surface's block that `read_apertures` reads back.

    What one Zemax aperture cannot say (a rectangle with a hole) does not come back, and is refused
    by the writer's comparison.
    """
    size, outline = row.get("semi_diameter"), row.get("aperture") or {}
    hole = row.get("obscuration") or {}
    if isinstance(hole, list | tuple):
        if len(hole) != 1:
            raise InputError(f"{place}: a .zmx file holds one obscuration a surface, not several")
        hole = hole[0]
    clips = row.get("clips", size != AUTOMATIC) and size is not None and not outline
    center = [{**hole, **outline}.get(key, 0.0) for key in _CENTER]
    automatic = size in (None, AUTOMATIC)
    lines = [f'DIAM {"0 0" if automatic else f"{_text(size, place)} 1"} 0 0 1 ""']
    for table, given in ((_PASSED, outline), (_BLOCKED, hole)):
        for operand, keys in table.items():
            if all(key in given for key in keys):
                lines.append(f"{operand} {' '.join(_text(given[key], place) for key in keys)}")
    if "polygons" in outline:
        lines += ["USAP 0 0 0"]
    elif "polygons" in hole:
        lines += ["USOB 0 0 0"]
    if "arms" in hole:
        lines.append(f"SPID {_text(hole['width'], place)} {_text(hole['arms'], place)} 0")
    ring = hole.get("inner_semi_diameter")
    inner = _text(0 if ring else hole.get("semi_diameter", 0), place)
    if ring:
        lines.append(f"OBSC {_text(ring, place)} {_text(hole['semi_diameter'], place)} 0")
    elif clips or "semi_diameter" in outline:
        outer = _text(size if clips else outline["semi_diameter"], place)
        lines.append(f"CLAP {inner} {outer} 0")
    elif inner != "0":
        lines.append(f"OBSC 0 {inner} 0")
    if any(float(as_number(value, place)) for value in center):
        lines.append(f"OBDC {' '.join(_text(value, place) for value in center)}")
    drawn = outline.get("polygons") or hole.get("polygons")
    if drawn:
        lines += _polygon_lines(drawn, place)
    return [f"  {line}" for line in lines]


def _spider(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Return the arms of a spider."""
    words = _words(block, "SPID")
    if len(words) < 2:
        raise InputError(f"{place}: SPID needs the width of the arms and their number")
    arms = number_in_text(words[1], f"{place}: SPID")
    if arms != int(arms) or arms < 1:
        raise InputError(f"{place}: SPID: the number of arms must be whole, from 1, not {words[1]}")
    return {"width": scaled(words[0], factor, f"{place}: SPID"), "arms": int(arms)}


def is_fixed(block: Block) -> bool:
    """Return whether a surface's DIAM is the user's own and not computed."""
    return _words(block, "DIAM")[1:2] == ["1"]


def _pair(block: Block, operand: str, factor: Fraction, place: str) -> tuple[float, float]:
    words = _words(block, operand)
    if len(words) < 2:
        raise InputError(f"{place}: {operand} needs two numbers")
    first, second = (scaled(word, factor, f"{place}: {operand}") for word in words[:2])
    return first, second


def _words(block: Block, operand: str) -> list[str]:
    return block[operand][-1].arguments if operand in block else []


def _text(value: object, place: str) -> str:
    number = as_number(value, place)
    return repr(number) if number else "0"


def _read_polygons(
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


def _polygon_lines(polygons: Sequence[Sequence[Sequence[float]]], place: str) -> list[str]:
    """Return the lines that `_read_polygons` reads back.

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
