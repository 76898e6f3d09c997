"""Clear apertures of surfaces are read from a prescription and written to it.

A surface gives `semi_diameter`, or `aperture` with a rectangle, an ellipse, a circle or polygons,
which may be beside the vertex, or both, where light must pass both; `obscuration` is what is
blocked, by one outline or by a list of them, each with a centre of its own::

    '1': {type: plane, semi_diameter: 6.35, obscuration: {semi_diameter: 2.0}, ...}
    '2': {type: plane, aperture: {half_width_x: 5.0, half_width_y: 4.0}, ...}
    '3': {type: plane, aperture: {semi_axis_x: 5.0, semi_axis_y: 7.0, decenter_y: 30.0}, ...}
    '4': {type: sphere, radius: 20, semi_diameter: 7.0, clips: false, ...}
    '5': {type: sphere, radius: 25, semi_diameter: auto, ...}
    '6': {type: plane, aperture: {polygons: [[[-4, -3], [4, -3], [0, 5]]]}, ...}
    '7': {type: plane, semi_diameter: 100, obscuration: [{semi_diameter: 34},
          {width: 2, arms: 4, angle: 45}, {inner_semi_diameter: 60, semi_diameter: 62}], ...}

`polygons` are lists of vertices [x, y] (mm): light passes inside each of them, and one inside
another is a hole.  A spider has `arms` of a `width` (mm), the first at an `angle` (degrees from +x
towards +y).

A surface that clips nothing is drawn to its semi-diameter, and light passes it wherever it is.
`auto` clips nothing either: when the lens is built, the semi-diameter becomes the one that the
light of the lens's fields needs (`dolens.prescriptions.automatic_apertures`).
"""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.surfaces.clear_aperture import (
    Circle,
    ClearAperture,
    Ellipse,
    Outline,
    Polygons,
    Rectangle,
    Ring,
    Spider,
    Together,
    Unlimited,
)
from dolens.optics.surfaces.outlines import CENTRE
from dolens.prescriptions.checks import as_number, as_numbers, require_mapping

APERTURE_KEYS = ("semi_diameter", "clips", "aperture", "obscuration")
AUTOMATIC = "auto"
# Of what is blocked; light is compared with each.
_MOST_PARTS = 1000
# Stands for an automatic semi-diameter (mm) until the light of the fields is known.
_UNKNOWN = 1.0
# Keys of an outline, all of them necessary, and what is made of their numbers.
_OUTLINES: tuple[tuple[tuple[str, ...], type[Outline]], ...] = (
    (("semi_diameter",), Circle),
    (("half_width_x", "half_width_y"), Rectangle),
    (("semi_axis_x", "semi_axis_y"), Ellipse),
    (("polygons",), Polygons),
)
_BLOCKING: tuple[tuple[tuple[str, ...], type[Outline]], ...] = (
    (("inner_semi_diameter", "semi_diameter"), Ring),
    *_OUTLINES,
    (("width", "arms"), Spider),
)
_OPTIONAL: dict[Any, tuple[str, ...]] = {Spider: ("angle",)}
_CENTER = ("decenter_x", "decenter_y")


def clear_aperture(row: Mapping[str, Any], place: str) -> ClearAperture:
    """Read the clear aperture of a surface from its row.

    Raises:
        InputError: none is given, or one that clips nothing has an outline, or a length is not
            positive.
    """
    size, outline = row.get("semi_diameter"), row.get("aperture")
    if size is None and outline is None:
        raise InputError(
            f"{place}: 'semi_diameter' is missing (mm, or {AUTOMATIC}: as the fields need it)"
        )
    clips = row.get("clips", not is_automatic(row))
    if not isinstance(clips, bool):
        raise InputError(f"{place}: 'clips' must be true or false, not {clips!r}")
    if clips and is_automatic(row):
        raise InputError(f"{place}: an automatic semi-diameter clips nothing ('clips: false')")
    if outline is not None and (not clips or is_automatic(row)):
        raise InputError(f"{place}: 'aperture' clips: it goes with no 'clips: false' and no 'auto'")
    centers = []
    edge: Outline | None = None
    window: Outline | None = None
    hole: Outline | None = None
    if size is not None:
        length = _UNKNOWN if is_automatic(row) else as_number(size, f"{place}: 'semi_diameter'")
        edge = Circle(length) if clips else Unlimited(length)
    if outline is not None:
        window, center = _outline(outline, _OUTLINES, f"{place}: 'aperture'")
        centers.append(center)
    if row.get("obscuration") is not None:
        hole, center = _obscuration(row["obscuration"], f"{place}: 'obscuration'")
        centers.append(center)
    center = centers[0] if centers else (0.0, 0.0)
    if len(centers) == 2 and any(centers[1]) and centers[1] != center:
        hole = Together(((hole, centers[1]),))
    if isinstance(hole, Together) and len(hole.parts) == 1 and outline is None:
        [(hole, center)] = hole.parts
    elif isinstance(hole, Together):
        # Its parts have centres of their own.
        parts = tuple((part, (x - center[0], y - center[1])) for part, (x, y) in hole.parts)
        hole = parts[0][0] if len(parts) == 1 and parts[0][1] == CENTRE else Together(parts)
    if edge is None:
        edge, window = window, None
        if isinstance(edge, Circle) and any(center):
            edge = Ellipse(edge.semi_diameter, edge.semi_diameter)
    elif isinstance(window, Circle):
        window = Ellipse(window.semi_diameter, window.semi_diameter)
    assert edge is not None  # one of the two is given
    try:
        return ClearAperture(edge, hole, window, center)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def is_automatic(row: Mapping[str, Any]) -> bool:
    """Return whether a row leaves its semi-diameter to the light of the fields."""
    return row.get("semi_diameter") == AUTOMATIC


def aperture_rows(aperture: ClearAperture) -> dict[str, Any]:
    """Return the keys of a surface's row that `clear_aperture` reads back."""
    rows: dict[str, Any] = {}
    beside = {key: value for key, value in zip(_CENTER, aperture.center, strict=True) if value}
    outline = aperture.window
    if isinstance(aperture.edge, Circle | Unlimited):
        rows["semi_diameter"] = aperture.edge.semi_diameter
        if not aperture.clips:
            rows["clips"] = False
    else:
        outline = aperture.edge
    if outline is not None:
        named: Any = outline  # all that may be here have a row
        rows["aperture"] = named.row() | beside
    hole = aperture.obscuration
    if isinstance(hole, Together):
        parts = [_beside(part.row(), _absolute(at, aperture.center)) for part, at in hole.parts]
        alone = len(parts) == 1 and not parts[0].keys().isdisjoint(_CENTER)
        rows["obscuration"] = parts[0] if alone else parts
    elif hole is not None:
        rows["obscuration"] = hole.row() | (beside if outline is None else {})
    return rows


def _beside(row: dict[str, Any], center: tuple[float, ...]) -> dict[str, Any]:
    """Return an outline's row with the place of its centre."""
    return row | {key: value for key, value in zip(_CENTER, center, strict=True) if value}


def _absolute(relative: tuple[float, float], center: tuple[float, float]) -> tuple[float, ...]:
    """Return the place whose difference from a centre is this one to the last bit."""
    found = []
    for part, middle in zip(relative, center, strict=True):
        guess = part + middle
        near = (guess, math.nextafter(guess, -math.inf), math.nextafter(guess, math.inf))
        found.append(next((x for x in near if x - middle == part), guess))
    return tuple(found)


def _obscuration(value: object, place: str) -> tuple[Outline, tuple[float, float]]:
    """Return what is blocked, and the centre of it: that of the vertex where there are several."""
    if not isinstance(value, list | tuple):
        return _outline(value, _BLOCKING, place)
    if not value:
        raise InputError(f"{place}: is an empty list")
    if len(value) > _MOST_PARTS:
        raise InputError(f"{place}: has {len(value)} parts (allowed: {_MOST_PARTS} at most)")
    parts = [_outline(part, _BLOCKING, f"{place} {number}") for number, part in enumerate(value, 1)]
    return Together(tuple(parts)), (0.0, 0.0)


def _outline(
    value: Any, outlines: tuple[tuple[tuple[str, ...], type[Outline]], ...], place: str
) -> tuple[Outline, tuple[float, float]]:
    """Return an outline, one of some kinds, and the centre of it."""
    require_mapping(value, place)
    optional = [key for keys in _OPTIONAL.values() for key in keys if outlines is _BLOCKING]
    known = dict.fromkeys((*(key for keys, _ in outlines for key in keys), *optional, *_CENTER))
    check_keys(value, tuple(known), place)
    x, y = (as_number(value.get(key, 0.0), f"{place}: '{key}'") for key in _CENTER)
    given = [entry for entry in outlines if any(key in value for key in entry[0])]
    if len(given) > 1 and given[0][1] is Ring and "inner_semi_diameter" not in value:
        given = given[1:]
    elif given and given[0][1] is Ring:
        given = [entry for entry in given if entry[1] is not Circle]
    if len(given) != 1:
        kinds = dict.fromkeys(" and ".join(keys) for keys, _ in outlines)
        raise InputError(f"{place}: give one of {', '.join(kinds)}")
    keys, make = given[0]
    for key in keys:
        if value.get(key) is None:
            raise InputError(f"{place}: '{key}' is missing (mm)")
    taken = (*keys, *_OPTIONAL.get(make, ()))
    check_keys(value, (*taken, *_CENTER), place)
    numbers = {key: value[key] for key in taken if value.get(key) is not None}
    try:
        if make is Polygons:
            return Polygons(_vertices(numbers["polygons"], f"{place}: 'polygons'")), (x, y)
        given_by_numbers: Any = make
        read = {k: as_number(v, f"{place}: '{k}'") for k, v in numbers.items()}
        return given_by_numbers(**read), (x, y)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(place) else f"{place}: {message}") from None


def _vertices(value: object, place: str) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Return the vertices of polygons."""
    found = as_numbers(value, place)
    polygons = found if isinstance(found, list) else []
    for polygon in polygons:
        if not isinstance(polygon, list) or not all(
            isinstance(vertex, list)
            and len(vertex) == 2
            and not any(isinstance(number, list) for number in vertex)
            for vertex in polygon
        ):
            polygons = []
            break
    if not polygons:
        raise InputError(f"{place}: must be a list of lists of vertices [x, y] (mm)")
    return tuple(tuple((x, y) for x, y in polygon) for polygon in polygons)
