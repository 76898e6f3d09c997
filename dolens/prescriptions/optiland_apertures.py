"""Apertures of Optiland are circles, rings, rectangles, ellipses, polygons, and differences.

A `DifferenceAperture` is its part `a` without its part `b`, which blocks light.
"""

from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_numbers
from dolens.prescriptions.json_values import mapping, number, rows

_CIRCLES = ("RadialAperture", "ConfigurableRadialAperture", "OffsetRadialAperture")


def aperture_row(content: object, place: str) -> dict[str, Any]:
    """Return a surface's clear aperture as a prescription's row has it.

    Raises:
        InputError: another kind of aperture.
    """
    if content is None:
        return {"semi_diameter": "auto"}
    aperture = mapping(content, f"{place}: 'aperture'")
    edge, holes = _outline(aperture, place)
    row: dict[str, Any] = {"aperture": edge}
    if list(edge) == ["semi_diameter"]:
        row = dict(edge)
    if holes:
        alone = len(holes) == 1 and list(edge) == ["semi_diameter"]
        row["obscuration"] = holes[0] if alone else holes
    return row


def _outline(aperture: dict[str, Any], place: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the outline that light passes, and those that block it."""
    kind = aperture.get("type")
    if kind == "DifferenceAperture":
        parts = [mapping(aperture.get(key), f"{place}: aperture: '{key}'") for key in "ab"]
        (edge, holes), (blocked, inside) = (_outline(part, place) for part in parts)
        if inside:
            raise InputError(f"{place}: an obscuration with a hole is not held")
        return edge, [*holes, blocked]
    beside = {
        f"decenter_{axis}": number(aperture, f"offset_{axis}", place, 0.0)
        for axis in "xy"
        if number(aperture, f"offset_{axis}", place, 0.0)
    }
    if kind in _CIRCLES:
        inner = number(aperture, "r_min", place, 0.0)
        holes = [{"semi_diameter": inner} | beside] if inner else []
        return {"semi_diameter": number(aperture, "r_max", place)} | beside, holes
    if kind == "EllipticalAperture":
        axes = {
            f"semi_axis_{axis}": number(aperture, key, place)
            for axis, key in zip("xy", "ab", strict=True)
        }
        return axes | beside, []
    if kind == "RectangularAperture":
        row: dict[str, Any] = {}
        for axis in "xy":
            low, high = (number(aperture, f"{axis}_{end}", place) for end in ("min", "max"))
            row[f"half_width_{axis}"] = 0.5 * (high - low)
            if low + high:
                row[f"decenter_{axis}"] = 0.5 * (low + high)
        return row, []
    if kind == "PolygonAperture":
        x, y = (as_numbers(rows(aperture.get(k), place), f"{place}: aperture: '{k}'") for k in "xy")
        if len(x) != len(y):
            raise InputError(f"{place}: a polygon's x and y must be as many")
        return {"polygons": [[list(vertex) for vertex in zip(x, y, strict=True)]]}, []
    raise InputError(f"{place}: an aperture of type {kind!r} is not held")
