"""Lens files of DeepLens are JSON: a list of surfaces with positions, radii and media.

`roc` is a radius of curvature (0 is a plane), `c` a curvature, `d_next` the gap behind, `mat2` the
medium behind, `r` the semi-diameter, of a square half its diagonal.  `ai` lists the coefficients of
r⁴, r⁶, ...; the first is that of r² unless `use_ai2` is false.  A surface is decentred by `pos_xy`
(mm), and its axis points along `vec_local`.  The stop is the surface with `is_aperture`, else the
one of type Aperture or Stop.  Wavelengths are in µm, and an object at -20 m stands for infinity.
"""

import math
from operator import mul
from typing import Any

from dolens.errors import InputError
from dolens.optics.materials import index_model, parse_material
from dolens.prescriptions.numbers import as_number, radius_row
from dolens.prescriptions.other_programs import D_LINE, ReadPrescription, paraxial_image
from dolens.prescriptions.plain_values import difference, even_powers, mapping, number, rows

_STOPS = ("Aperture", "Stop")
_NOT_HELD = {
    "ThinLens": "a paraxial lens",
    "ParaxialLens": "a paraxial lens",
    "DOE": "a diffractive element",
    "Phase": "a diffractive phase",
    "Fresnel": "a diffractive Fresnel lens",
    "Binary2": "a diffractive phase",
    "Grating": "a diffraction grating",
    "Cubic": "a cubic surface",
}
# Positions and gaps are rounded on their own, mm.
_POSITIONS = 1e-3
# Focal lengths that are noted are rounded, and of other wavelengths.
_FOCAL_LENGTHS = 0.05
_FAR = -20000.0


def read_deeplens(content: dict[str, Any], where: str) -> ReadPrescription:
    """Convert the content of a DeepLens file to a prescription.

    Raises:
        InputError: a surface is of a kind that is not held, or positions and gaps disagree.
    """
    for key in ("DOE", "doe"):
        if content.get(key):
            raise InputError(f"{where}: a diffractive element is not held ('{key}')")
    found: dict[str, dict[str, Any]] = {}
    entries = rows(content.get("surfaces"), f"{where}: 'surfaces'")
    first = mapping(entries[0] if entries else None, f"{where}: surface 1")
    stops, before, end = [], "air", number(first, "d", where, 0.0)
    poses: dict[str, dict[str, Any]] = {}
    marked = any(isinstance(entry, dict) and entry.get("is_aperture") for entry in entries)
    for n, entry in enumerate(entries, 1):
        place = f"{where}: surface {n}"
        surface = mapping(entry, place)
        row = _row(surface, before, place)
        if surface.get("is_aperture") if marked else surface.get("type") in _STOPS:
            stops.append(n)
        pose = _pose(surface, place)
        if pose:
            poses[str(n)] = {"surfaces": [n, n], **pose}
        before = row["material"]
        gap = number(surface, "d_next", place)
        end += gap if n < len(entries) else 0.0
        found[str(n)] = row | ({"thickness": gap} if n < len(entries) else {})
    if len(stops) > 1:
        raise InputError(f"{where}: surfaces {stops[0]} and {stops[1]} are both the stop")
    if not stops:
        raise InputError(f"{where}: no surface is the stop (type Aperture, or 'is_aperture')")
    prescription: dict[str, Any] = {"index_model": "dfc", "stop": stops[0]}
    prescription |= _system(content, where) | {"surfaces": found}
    if poses:
        prescription["elements"] = poses
    if content.get("info"):
        prescription = {"name": str(content["info"]), **prescription}
    prescription["sensor"] = _sensor(content, mapping(entries[-1], where), end, where)
    _require_focal_length(content, found, where)
    return ReadPrescription(prescription, [])


def _system(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the wavelengths in nm, the primary one as reference, and the object's distance.

    A primary wavelength that is none of the three has no weight in what is polychromatic.
    """
    found: dict[str, Any] = {}
    colours = rows(content.get("wvln_rgb", []), f"{where}: 'wvln_rgb'")
    waves = [_nanometres(colour, f"{where}: 'wvln_rgb'") for colour in colours]
    if content.get("primary_wvln") is not None:
        primary = _nanometres(content["primary_wvln"], f"{where}: 'primary_wvln'")
        if waves and primary not in waves:
            found["wavelength_weights"] = [*(1.0 for _ in waves), 0.0]
        waves = waves if primary in waves else [*waves, primary]
        found["reference_wavelength"] = primary
    if waves:
        found["wavelengths"] = waves
    depth = number(content, "obj_depth", where, _FAR)
    return found if depth == _FAR else {**found, "object_distance": -depth}


def _nanometres(value: object, place: str) -> float:
    return round(1e3 * as_number(value, place), 9)


def _require_focal_length(
    content: dict[str, Any], surfaces: dict[str, dict[str, Any]], where: str
) -> None:
    """Refuse a lens whose own focal length is not the one that the file notes.

    Some programs built on DeepLens fold the light between the surfaces of a file; then the surfaces
    one after the other are another lens.
    """
    if content.get("foclen") is None:
        return
    said = as_number(content["foclen"], f"{where}: 'foclen'")
    model = index_model("dfc")
    curvatures, indices = [], [1.0]
    for row in surfaces.values():
        radius = row.get("radius", math.inf)
        curvatures.append(row.get("curvature", 1.0 / radius) + 2.0 * row.get("a2", 0.0))
        try:
            indices.append(float(parse_material(str(row["material"]), model).index(D_LINE)))
        except InputError:
            return  # the lens is refused for this medium, by name, when it is built
    gaps = [row["thickness"] for row in surfaces.values() if "thickness" in row]
    own = paraxial_image(curvatures, gaps, indices, None, where).focal_length
    if abs(own - said) > _FOCAL_LENGTHS * abs(said):
        raise InputError(
            f"{where}: 'foclen' says {said:.4g} mm, and the surfaces one after the other give "
            f"{own:.4g} mm: a folded path, or what else makes the difference, is not held"
        )


def _row(surface: dict[str, Any], before: str, place: str) -> dict[str, Any]:
    kind = str(surface.get("type"))
    material = str(surface.get("mat2", before if kind in _STOPS else "")).strip()
    if not material:
        raise InputError(f"{place}: 'mat2' is missing (the medium behind the surface)")
    material = "air" if material.lower() in ("air", "vacuum", "occluder") else material
    row: dict[str, Any] = {}
    if kind in _STOPS:
        if number(surface, "c", place, 0.0):
            raise InputError(f"{place}: a stop with a curvature is not held")
        row = {"type": "aperture"}
    elif kind == "Plane":
        row = {"type": "plane"}
    elif kind in ("Spheric", "Aspheric"):
        row = {"type": "sphere", **_curvature(surface, place)}
        if kind == "Aspheric":
            row |= {"type": "even_asphere", "conic": number(surface, "k", place, 0.0)}
            row |= even_powers(surface, "ai", place, 1 if surface.get("use_ai2", True) else 2)
    else:
        what = _NOT_HELD.get(kind, f"type '{kind}'")
        raise InputError(
            f"{place}: {what} is not held (allowed: Aperture, Plane, Spheric, Aspheric)"
        )
    return row | {"material": material} | _aperture(surface, place)


def _aperture(surface: dict[str, Any], place: str) -> dict[str, Any]:
    """Return the clear aperture; a square has the side `l`."""
    if surface.get("is_square") and surface.get("l") is not None:
        half = number(surface, "l", place) / 2.0
        return {"aperture": {"half_width_x": half, "half_width_y": half}}
    if surface.get("is_square"):
        half = number(surface, "r", place) / math.sqrt(2.0)
        return {"aperture": {"half_width_x": half, "half_width_y": half}}
    if surface.get("r") is None and surface.get("l") is not None:
        return {"semi_diameter": number(surface, "l", place) / 2.0}
    return {"semi_diameter": number(surface, "r", place)}


def _curvature(surface: dict[str, Any], place: str) -> dict[str, float]:
    if surface.get("roc") is not None:
        radius = as_number(surface["roc"], f"{place}: 'roc'")
        return {"radius": radius or math.inf}
    return radius_row(number(surface, "c", place))


def _pose(surface: dict[str, Any], place: str) -> dict[str, float]:
    """Return decenters (mm) and tilts (degrees) of a surface; nothing where it is on the axis.

    The shortest turn from z to the axis (a, b, c) takes x to (1 - a²/(1 + c), -ab/(1 + c), -a).
    """
    found = dict(
        zip(("decenter_x", "decenter_y"), _vector(surface, "pos_xy", 2, place), strict=True)
    )
    axis = _vector(surface, "vec_local", 3, place) if "vec_local" in surface else [0.0, 0.0, 1.0]
    length = math.hypot(*axis)
    if length == 0.0 or axis[2] <= 0.0:
        raise InputError(f"{place}: 'vec_local' must point towards +z, not {axis}")
    a, b, c = (part / length for part in axis)
    tilt_x, tilt_y = math.atan2(-b, c), math.asin(a)
    across = (1.0 - a * a / (1.0 + c), -a * b / (1.0 + c), -a)
    turned_y = (0.0, math.cos(tilt_x), math.sin(tilt_x))
    turned_x = (math.cos(tilt_y), -turned_y[2] * -a, -turned_y[1] * a)
    tilt_z = math.atan2(*(sum(map(mul, across, side)) for side in (turned_y, turned_x)))
    angles = zip(("tilt_x", "tilt_y", "tilt_z"), (tilt_x, tilt_y, tilt_z), strict=True)
    found |= {name: math.degrees(angle) for name, angle in angles}
    return {name: value for name, value in found.items() if value}


def _vector(surface: dict[str, Any], key: str, count: int, place: str) -> list[float]:
    """Return a list of so many numbers, zeros where there is none."""
    values = rows(surface.get(key, [0.0] * count), f"{place}: '{key}'")
    if len(values) != count:
        raise InputError(f"{place}: '{key}' must be a list of {count} numbers")
    return [as_number(value, f"{place}: '{key}'") for value in values]


def _sensor(
    content: dict[str, Any], last: dict[str, Any], end: float, where: str
) -> dict[str, Any]:
    """Return the sensor: its distance, and the diameter of the circle around it."""
    gap = number(last, "d_next", f"{where}: the last surface")
    if content.get("d_sensor") is not None:
        distance = difference(number(content, "d_sensor", where), end, where)
        if abs(distance - gap) > _POSITIONS:
            raise InputError(
                f"{where}: 'd_sensor' puts the sensor {distance:g} mm behind the last surface, and "
                f"its 'd_next' says {gap:g} mm"
            )
    sensor = {"distance": gap}
    if content.get("r_sensor") is not None:
        sensor["diameter"] = 2.0 * number(content, "r_sensor", where)
    elif content.get("sensor_size") is not None:
        sensor["diameter"] = math.hypot(*_vector(content, "sensor_size", 2, where))
    return sensor
