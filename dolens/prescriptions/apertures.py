"""Clear apertures of surfaces are read from a prescription and written to it.

A surface gives `semi_diameter`, or `aperture` with a rectangle, an ellipse or a circle, which may
be beside the vertex, or both, where light must pass both; `obscuration` is what is blocked::

    '1': {type: plane, semi_diameter: 6.35, obscuration: {semi_diameter: 2.0}, ...}
    '2': {type: plane, aperture: {half_width_x: 5.0, half_width_y: 4.0}, ...}
    '3': {type: plane, aperture: {semi_axis_x: 5.0, semi_axis_y: 7.0, decenter_y: 30.0}, ...}
    '4': {type: sphere, radius: 20, semi_diameter: 7.0, clips: false, ...}
    '5': {type: sphere, radius: 25, semi_diameter: auto, ...}

A surface that clips nothing is drawn to its semi-diameter, and light passes it wherever it is.
`auto` clips nothing either: when the lens is built, the semi-diameter becomes the one that the
light of the lens's fields needs (`dolens.prescriptions.automatic_apertures`).
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.surfaces.clear_aperture import (
    Circle,
    ClearAperture,
    Ellipse,
    Outline,
    Rectangle,
    Unlimited,
)
from dolens.prescriptions.checks import as_number, require_mapping

APERTURE_KEYS = ("semi_diameter", "clips", "aperture", "obscuration")
AUTOMATIC = "auto"
# Stands for an automatic semi-diameter (mm) until the light of the fields is known.
_UNKNOWN = 1.0
_OUTLINES: tuple[tuple[tuple[str, ...], type[Outline]], ...] = (
    (("semi_diameter",), Circle),
    (("half_width_x", "half_width_y"), Rectangle),
    (("semi_axis_x", "semi_axis_y"), Ellipse),
)
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
    edge = window = hole = None
    if size is not None:
        length = _UNKNOWN if is_automatic(row) else as_number(size, f"{place}: 'semi_diameter'")
        edge = Circle(length) if clips else Unlimited(length)
    if outline is not None:
        window, center = _outline(outline, f"{place}: 'aperture'")
        centers.append(center)
    if row.get("obscuration") is not None:
        hole, center = _outline(row["obscuration"], f"{place}: 'obscuration'")
        centers.append(center)
    center = centers[0] if centers else (0.0, 0.0)
    if len(centers) == 2 and any(centers[1]) and centers[1] != center:
        raise InputError(f"{place}: 'aperture' and 'obscuration' must have one decenter")
    if edge is None:
        edge, window = window, None
        if isinstance(edge, Circle) and any(center):
            edge = Ellipse(edge.semi_diameter, edge.semi_diameter)
    elif isinstance(window, Circle):
        window = Ellipse(window.semi_diameter, window.semi_diameter)
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
        rows["aperture"] = vars(outline) | beside
    if aperture.obscuration is not None:
        rows["obscuration"] = vars(aperture.obscuration) | (beside if outline is None else {})
    return rows


def _outline(value: object, place: str) -> tuple[Outline, tuple[float, float]]:
    """Return an outline, and the centre of it."""
    require_mapping(value, place)
    check_keys(value, (*(key for keys, _ in _OUTLINES for key in keys), *_CENTER), place)
    x, y = (as_number(value.get(key, 0.0), f"{place}: '{key}'") for key in _CENTER)
    given = [(keys, make) for keys, make in _OUTLINES if any(key in value for key in keys)]
    if len(given) != 1:
        raise InputError(
            f"{place}: give one of {', '.join(' and '.join(keys) for keys, _ in _OUTLINES)}"
        )
    keys, make = given[0]
    for key in keys:
        if value.get(key) is None:
            raise InputError(f"{place}: '{key}' is missing (mm)")
    return make(*(as_number(value[key], f"{place}: '{key}'") for key in keys)), (x, y)
