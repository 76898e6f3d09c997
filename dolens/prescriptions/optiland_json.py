"""Lens files of Optiland are JSON: surfaces with their shapes, positions and media, and the system.

Positions are those of the axes of each surface in global axes; gaps are their differences.  Glass
names the file of refractiveindex.info that its data came from, and so its maker.  The first surface
is the object, the last one the image.

Of its apertures, a `DifferenceAperture` is its part `a` without its part `b`, which blocks light.
"""

import math
import re
from typing import Any

from dolens.errors import InputError
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.glass_catalog import find_glass
from dolens.prescriptions.numbers import as_number, as_numbers
from dolens.prescriptions.other_programs import ReadPrescription, curved_object, image_shape
from dolens.prescriptions.plain_values import (
    difference,
    even_powers,
    mapping,
    number,
    require_unset,
    rows,
)
from dolens.prescriptions.system_data import unequal_weights

_FIELDS = {
    "angle": "angles",
    "object_height": "heights",
    "paraxial_image_height": "image_heights",
    "real_image_height": "real_image_heights",
}
_PUPILS = {"EPD": "entrance_pupil_diameter", "imageFNO": "f_number", "objectNA": "object_na"}
_MAKER = re.compile(r"[\\/](schott|ohara|hoya|cdgm|sumita|hikari)[\\/]", re.IGNORECASE)
_NM = {"um": 1e3, "nm": 1.0, "mm": 1e6, "m": 1e9}
_INFINITE = 1e10
# How light goes on behind a surface: by refraction or reflection, or as an ideal lens sends it.
_REFRACTS, _IDEAL = "RefractiveReflectiveModel", "ThinLensInteractionModel"
_DEFINITIONS = {
    "AngleField": "angle",
    "ObjectHeightField": "object_height",
    "ParaxialImageHeightField": "paraxial_image_height",
    "RealImageHeightField": "real_image_height",
}
_CIRCLES = ("RadialAperture", "ConfigurableRadialAperture", "OffsetRadialAperture")


def read_optiland(content: dict[str, Any], where: str) -> ReadPrescription:
    """Convert the content of an Optiland file to a prescription.

    Raises:
        InputError: a surface is of a shape that is not held, tilted or decentred, or a medium is
            none that is known here.
    """
    group = mapping(content.get("surface_group"), f"{where}: 'surface_group'")
    surfaces = rows(group.get("surfaces"), f"{where}: 'surfaces'")
    surfaces = [mapping(s, f"{where}: surface {n}") for n, s in enumerate(surfaces)]
    if len(surfaces) < 3:
        raise InputError(f"{where}: needs an object, a surface and an image")
    require_unset(mapping(content.get("pickups") or {}, where), (), "a pick-up", where)
    prescription: dict[str, Any] = {"index_model": "dfc"}
    if content.get("name"):
        prescription = {"name": str(content["name"]), **prescription}
    prescription |= _wavelengths(
        mapping(content.get("wavelengths"), f"{where}: 'wavelengths'"), where
    )
    prescription |= _fields(mapping(content.get("fields"), f"{where}: 'fields'"), where)
    prescription |= _pupil(content, where)
    positions = [_position(surface, f"{where}: surface {n}") for n, surface in enumerate(surfaces)]
    for end, what in ((surfaces[0], "object"), (surfaces[-1], "image")):
        _require_plain_end(end, f"{where}: the {what}")
    prescription["object_material"] = _medium(surfaces[0], f"{where}: surface 0")
    if math.isfinite(positions[0]) and abs(positions[0]) < _INFINITE:
        gap = difference(positions[1], positions[0], where)
        prescription["object_distance"] = gap
    stops = [n for n, surface in enumerate(surfaces) if surface.get("is_stop")]
    if len(stops) != 1 or not 1 <= stops[0] <= len(surfaces) - 2:
        raise InputError(f"{where}: one surface must be the stop ('is_stop'), not {len(stops)}")
    prescription["stop"] = stops[0]
    found: dict[str, dict[str, Any]] = {}
    before = prescription["object_material"]
    for n, surface in enumerate(surfaces[1:-1], 1):
        place = f"{where}: surface {n}"
        row = _row(surface, n == stops[0], before, place)
        if row["material"] != "mirror":
            before = row["material"]
        gap = difference(positions[n + 1], positions[n], place)
        if n < len(surfaces) - 2:
            row["thickness"] = gap
        found[str(n)] = row
    prescription["surfaces"] = found
    place = f"{where}: the image"
    shape = _shape(mapping(surfaces[-1].get("geometry"), f"{place}: 'geometry'"), place)
    prescription["sensor"] = {"distance": gap} | image_shape(shape, place)
    place = f"{where}: the object"
    shape = _shape(mapping(surfaces[0].get("geometry"), f"{place}: 'geometry'"), place)
    return ReadPrescription(prescription, curved_object(prescription, shape, place))


def _require_plain_end(surface: dict[str, Any], place: str) -> None:
    """Refuse an object or image that sends light on as no dummy surface does."""
    if surface.get("type") not in ("ObjectSurface", "ImageSurface", "Surface", "StandardSurface"):
        raise InputError(f"{place}: a surface of type {surface.get('type')!r} is not held")
    action = mapping(surface.get("interaction_model") or {}, f"{place}: 'interaction_model'")
    if action.get("type", _REFRACTS) != _REFRACTS or action.get("is_reflective"):
        raise InputError(f"{place}: an interaction other than refraction is not held")


def _row(surface: dict[str, Any], stop: bool, before: str, place: str) -> dict[str, Any]:
    """Return type, radius, coefficients, medium and aperture of a surface."""
    if surface.get("type") not in ("Surface", "StandardSurface"):
        raise InputError(f"{place}: a surface of type {surface.get('type')!r} is not held")
    geometry = mapping(surface.get("geometry"), f"{place}: 'geometry'")
    action = mapping(surface.get("interaction_model") or {}, f"{place}: 'interaction_model'")
    # Since 0.5 the interaction says whether a surface reflects, before that the surface itself.
    reflects = bool(surface.get("is_reflective")) or bool(action.get("is_reflective"))
    material = "mirror" if reflects else _medium(surface, place)
    kind = action.get("type", _REFRACTS)
    if surface.get("surface_type") == "paraxial" or kind == _IDEAL:
        row = _ideal_lens(surface, action, geometry, reflects, place)
    elif kind != _REFRACTS:
        raise InputError(
            f"{place}: an interaction of type {kind!r} is not held (allowed: {_REFRACTS}, {_IDEAL})"
        )
    else:
        row = _shape(geometry, place)
    if row == {"type": "plane"} and stop and material == before:
        row = {"type": "aperture"}
    return row | {"material": material} | _aperture_row(surface.get("aperture"), place)


def _ideal_lens(
    surface: dict[str, Any],
    action: dict[str, Any],
    geometry: dict[str, Any],
    reflects: bool,
    place: str,
) -> dict[str, Any]:
    """Return a thin lens without aberrations, of the focal length f in mm."""
    if reflects:
        raise InputError(f"{place}: an ideal mirror (a paraxial surface that reflects) is not held")
    if _shape(geometry, place)["type"] != "plane":
        raise InputError(f"{place}: an ideal lens that is not plane is not held")
    length = next((e[k] for e in (action, surface) for k in ("focal_length", "f") if k in e), None)
    if length is None:
        raise InputError(f"{place}: an ideal lens without its 'focal_length'")
    where = f"{place}: 'focal_length'"
    return {"type": "paraxial_lens", "focal_length": as_number(_first(length), where, finite=False)}


def _shape(geometry: dict[str, Any], place: str) -> dict[str, Any]:
    kind = geometry.get("type")
    radius = as_number(geometry.get("radius", math.inf), f"{place}: 'radius'", finite=False)
    if kind == "Plane":
        if math.isfinite(radius):
            raise InputError(f"{place}: a Plane has no radius, not {radius:g}")
        return {"type": "plane"}
    conic = number(geometry, "conic", place, 0.0)
    if kind == "StandardGeometry":
        if math.isinf(radius) and not conic:
            return {"type": "plane"}
        shape = {"type": "conic" if conic else "sphere", "radius": radius}
        return shape | ({"conic": conic} if conic else {})
    if kind == "EvenAsphere":
        terms = even_powers(geometry, "coefficients", place)
        return {"type": "even_asphere", "radius": radius, "conic": conic, **terms}
    raise InputError(
        f"{place}: a surface of shape {kind!r} is not held "
        "(allowed: Plane, StandardGeometry, EvenAsphere)"
    )


def _medium(surface: dict[str, Any], place: str) -> str:
    """Return the medium behind a surface as a prescription writes it."""
    material = mapping(surface.get("material_post"), f"{place}: 'material_post'")
    kind = material.get("type")
    require_unset(material, ("absorp",), "absorption", place)
    spreading = mapping(material.get("propagation_model") or {}, place).get("class")
    if spreading not in (None, "HomogeneousPropagation"):
        raise InputError(f"{place}: a medium with {spreading!r} is not held")
    if kind == "IdealMaterial":
        index = as_number(_first(material.get("index")), f"{place}: 'index'")
        return "air" if index == 1.0 else repr(index)
    if kind == "AbbeMaterial":
        nd, vd = (as_number(_first(material.get(k)), f"{place}: {k!r}") for k in ("index", "abbe"))
        return f"{nd!r}/{vd!r}"
    if kind != "Material":
        raise InputError(f"{place}: a medium of type {kind!r} is not held")
    name = str(material.get("name"))
    said = f"{material.get('filename') or ''}"
    maker = _MAKER.search(said)
    known = maker[1] if maker else str(material.get("reference") or "")
    try:
        return find_glass(f"{known}:{name}" if known else name).name
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def _first(value: object) -> object:
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _position(surface: dict[str, Any], place: str) -> float:
    """Return z of a surface's vertex, mm; infinite for a far object."""
    geometry = mapping(surface.get("geometry"), f"{place}: 'geometry'")
    axes = mapping(geometry.get("cs"), f"{place}: 'cs'")
    require_unset(axes, ("x", "y", "rx", "ry", "rz"), "a decentred or tilted surface", place)
    reference = axes.get("reference_cs")
    if reference is not None:
        require_unset(
            mapping(reference, place),
            ("x", "y", "z", "rx", "ry", "rz"),
            "a surface in axes of another",
            place,
        )
    value = axes.get("z")
    if value == "inf" or value == "-inf" or (isinstance(value, float) and math.isinf(value)):
        return math.inf
    return as_number(value, f"{place}: 'z'")


def _wavelengths(content: dict[str, Any], where: str) -> dict[str, Any]:
    values, weights, primary = [], [], None
    for entry in rows(content.get("wavelengths"), f"{where}: 'wavelengths'"):
        wave = mapping(entry, f"{where}: 'wavelengths'")
        unit = str(wave.get("unit", "um"))
        if unit not in _NM:
            raise InputError(f"{where}: a wavelength in '{unit}' (allowed: {', '.join(_NM)})")
        value = round(number(wave, "value", where) * _NM[unit], 9)
        require_wavelengths([value], f"{where}: 'wavelengths'", "µm" if unit == "um" else "nm")
        values.append(value)
        weights.append(number(wave, "weight", where, 1.0))
        if wave.get("is_primary"):
            if primary is not None:
                raise InputError(f"{where}: two wavelengths are primary ('is_primary')")
            primary = value
    if not values:
        return {}
    found: dict[str, Any] = {"wavelengths": values, "reference_wavelength": primary or values[0]}
    place = f"{where}: weights of the wavelengths"
    return found | unequal_weights("wavelength_weights", weights, len(values), place)


def _fields(content: dict[str, Any], where: str) -> dict[str, Any]:
    require_unset(
        content, ("telecentric", "object_space_telecentric"), "a telecentric object", where
    )
    entries = [
        mapping(entry, f"{where}: 'fields'")
        for entry in rows(content.get("fields"), f"{where}: 'fields'")
    ]
    if not entries:
        return {}
    definition = content.get("field_definition")
    named = content.get("field_type") or entries[0].get("field_type")
    if isinstance(definition, dict):
        named = named or _DEFINITIONS.get(str(definition.get("field_type")))
    if not isinstance(named, str) or named not in _FIELDS:
        raise InputError(
            f"{where}: fields of type {named!r} are not held (allowed: {', '.join(_FIELDS)})"
        )
    points = [[number(e, "x", where, 0.0), number(e, "y", where, 0.0)] for e in entries]
    found: dict[str, Any] = {_FIELDS[named]: points}
    cut = [(number(e, "vx", where, 0.0), number(e, "vy", where, 0.0)) for e in entries]
    if any(any(pair) for pair in cut):
        found["vignetting"] = [{"compression_x": x, "compression_y": y} for x, y in cut]
    weights = [number(e, "weight", where, 1.0) for e in entries]
    place = f"{where}: weights of the fields"
    return {"fields": found | unequal_weights("weights", weights, len(points), place)}


def _pupil(content: dict[str, Any], where: str) -> dict[str, Any]:
    aperture = content.get("aperture")
    if aperture is None:
        return {}
    aperture = mapping(aperture, f"{where}: 'aperture'")
    require_unset(aperture, ("object_space_telecentric",), "a telecentric object", where)
    kind = str(aperture.get("type"))
    if kind == "float_by_stop_size":
        return {}
    if kind not in _PUPILS:
        raise InputError(f"{where}: an aperture of type '{kind}' is not held")
    return {_PUPILS[kind]: number(aperture, "value", where)}


def _aperture_row(content: object, place: str) -> dict[str, Any]:
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
