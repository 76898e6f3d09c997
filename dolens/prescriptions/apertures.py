"""Clear apertures of surfaces are read from a prescription and written to it.

A surface gives `semi_diameter`, or `aperture` with a rectangle; `obscuration` is what is blocked::

    '1': {type: plane, semi_diameter: 6.35, obscuration: {semi_diameter: 2.0}, ...}
    '2': {type: plane, aperture: {half_width_x: 5.0, half_width_y: 4.0}, ...}
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Outline, Rectangle
from dolens.prescriptions.checks import as_number, require_mapping

APERTURE_KEYS = ("semi_diameter", "aperture", "obscuration")
_RECTANGLE = ("half_width_x", "half_width_y")


def clear_aperture(row: Mapping[str, Any], place: str) -> ClearAperture:
    """Read the clear aperture of a surface from its row.

    Raises:
        InputError: none is given, or two are, or a length is not positive.
    """
    given = [key for key in ("semi_diameter", "aperture") if row.get(key) is not None]
    if not given:
        raise InputError(f"{place}: 'semi_diameter' is missing (mm)")
    if len(given) == 2:
        raise InputError(f"{place}: give 'semi_diameter' or 'aperture', not both")
    if given == ["semi_diameter"]:
        edge: Outline = _circle(row, place)
    else:
        edge = _outline(row["aperture"], f"{place}: 'aperture'")
    obscuration = row.get("obscuration")
    if obscuration is not None:
        obscuration = _outline(obscuration, f"{place}: 'obscuration'")
    try:
        return ClearAperture(edge, obscuration)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def aperture_rows(aperture: ClearAperture) -> dict[str, Any]:
    """Return the keys of a surface's row that `clear_aperture` reads back."""
    rows: dict[str, Any] = {}
    if isinstance(aperture.edge, Circle):
        rows["semi_diameter"] = aperture.edge.semi_diameter
    else:
        rows["aperture"] = dict(vars(aperture.edge))
    if aperture.obscuration is not None:
        rows["obscuration"] = dict(vars(aperture.obscuration))
    return rows


def _circle(row: Mapping[str, Any], place: str) -> Circle:
    return Circle(as_number(row["semi_diameter"], f"{place}: 'semi_diameter'"))


def _outline(value: object, place: str) -> Outline:
    require_mapping(value, place)
    check_keys(value, ("semi_diameter", *_RECTANGLE), place)
    if value.get("semi_diameter") is not None:
        if any(key in value for key in _RECTANGLE):
            raise InputError(f"{place}: give 'semi_diameter' or half widths, not both")
        return _circle(value, place)
    for key in _RECTANGLE:
        if value.get(key) is None:
            raise InputError(f"{place}: '{key}' is missing (mm)")
    return Rectangle(*(as_number(value[key], f"{place}: '{key}'") for key in _RECTANGLE))
