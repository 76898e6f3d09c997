"""Lens files of ray-optics (.roa) are JSON of the program's objects, of which these are read.

`seq_model` lists interfaces and the gaps behind them, `profile_dict` their shapes, `optical_spec`
wavelengths, fields and pupil.  The first interface is the object, the last one the image.  Glass
has its maker's name, a model glass nd and Vd.
"""

import math
from typing import Any

from dolens.errors import InputError
from dolens.optics.glass_catalog import find_glass
from dolens.prescriptions.numbers import as_number, radius_row
from dolens.prescriptions.other_programs import ReadPrescription, curved_object, image_shape
from dolens.prescriptions.plain_values import mapping, number, require_unset, rows
from dolens.prescriptions.system_data import unequal_weights

_MAKERS = ("Schott", "Ohara", "Hoya", "CDGM", "Hikari", "Sumita")
_FIELDS = {
    ("object", "angle"): "angles",
    ("object", "height"): "heights",
    ("image", "height"): "image_heights",
    ("image", "real height"): "real_image_heights",
}
_UNITS = {"mm": 1.0}
_INFINITE = 1e10


def read_ray_optics(content: dict[str, Any], where: str) -> ReadPrescription:
    """Convert the content of a .roa file to a prescription.

    Raises:
        InputError: a surface, a medium or a pupil is of a kind that is not held.
    """
    model = _object(content.get("optical_model"), f"{where}: 'optical_model'")
    system = _object(model.get("system_spec"), f"{where}: 'system_spec'")
    unit = str(system.get("_dimensions", system.get("dimensions", "mm"))).lower()
    if unit not in _UNITS:
        raise InputError(f"{where}: lengths in {unit} are not held (allowed: mm)")
    sequence = _object(model.get("seq_model"), f"{where}: 'seq_model'")
    interfaces = rows(sequence.get("ifcs"), f"{where}: 'ifcs'")
    gaps = rows(sequence.get("gaps"), f"{where}: 'gaps'")
    if len(interfaces) < 3 or len(gaps) != len(interfaces) - 1:
        raise InputError(f"{where}: needs an object, a surface and an image, and the gaps between")
    profiles = mapping(model.get("profile_dict") or {}, f"{where}: 'profile_dict'")
    prescription: dict[str, Any] = {"index_model": "dfc"}
    if system.get("title"):
        prescription = {"name": str(system["title"]), **prescription}
    spaces = [_object(gap, f"{where}: gap {n}") for n, gap in enumerate(gaps)]
    media = [_medium(space.get("medium"), f"{where}: gap {n}") for n, space in enumerate(spaces)]
    lengths = [number(space, "thi", f"{where}: gap {n}") for n, space in enumerate(spaces)]
    finite = abs(lengths[0]) < _INFINITE
    prescription |= _specification(model, finite, where)
    prescription["object_material"] = media[0]
    target = _shape(_object(interfaces[0], where), profiles, f"{where}: the object")
    if finite:
        prescription["object_distance"] = lengths[0]
    stop = sequence.get("stop_surface")
    if not isinstance(stop, int) or isinstance(stop, bool) or not 1 <= stop <= len(interfaces) - 2:
        raise InputError(
            f"{where}: a stop that no surface is ('stop_surface' {stop!r}) is not held"
        )
    prescription["stop"] = stop
    found: dict[str, dict[str, Any]] = {}
    for n, interface in enumerate(interfaces[1:-1], 1):
        place = f"{where}: surface {n}"
        row = _row(interface, profiles, media[n - 1], media[n], n == stop, place)
        found[str(n)] = row | ({"thickness": lengths[n]} if n < len(interfaces) - 2 else {})
    prescription["surfaces"] = found
    place = f"{where}: the image"
    shape = _shape(_object(interfaces[-1], place), profiles, place)
    prescription["sensor"] = {"distance": lengths[-1]} | image_shape(shape, place)
    place = f"{where}: the object"
    return ReadPrescription(prescription, curved_object(prescription, target, place))


def _row(
    interface: object, profiles: dict[str, Any], before: str, behind: str, stop: bool, place: str
) -> dict[str, Any]:
    surface = _object(interface, place)
    kind = _class(interface)
    if kind == "ThinLens":
        raise InputError(f"{place}: a paraxial lens (ThinLens) is not held")
    if kind != "Surface":
        raise InputError(f"{place}: an interface of type {kind!r} is not held")
    require_unset(surface, ("decenter",), "a decentred or tilted surface", place)
    require_unset(surface, ("phase_element",), "a diffractive element", place)
    mode = surface.get("interact_mode")
    if mode not in ("transmit", "dummy", "reflect"):
        raise InputError(f"{place}: an interface that acts as {mode!r} is not held")
    row = _shape(surface, profiles, place)
    material = "mirror" if mode == "reflect" else behind
    if row == {"type": "plane"} and stop and material == before:
        row = {"type": "aperture"}
    if surface.get("label"):
        row["note"] = str(surface["label"])
    return row | {"material": material} | _aperture(surface, place)


def _shape(surface: dict[str, Any], profiles: dict[str, Any], place: str) -> dict[str, Any]:
    profile = surface.get("profile") or profiles.get(str(surface.get("profile_id")))
    shape, kind = _object(profile, f"{place}: profile"), _class(profile)
    curvature = number(shape, "cv", place, 0.0)
    if kind == "Spherical":
        return {"type": "sphere", **radius_row(curvature)} if curvature else {"type": "plane"}
    conic = {"conic": number(shape, "cc", place, 0.0)}
    if kind == "Conic":
        return {"type": "conic", **radius_row(curvature), **conic}
    if kind == "EvenPolynomial":
        values = rows(_array(shape.get("coefs", [])), f"{place}: 'coefs'")
        numbers = [as_number(value, f"{place}: 'coefs'") for value in values]
        used = max((i for i, value in enumerate(numbers, 1) if value), default=0)
        terms = {f"a{2 * i}": value for i, value in enumerate(numbers[:used], 1)}
        if not terms.get("a2"):
            terms.pop("a2", None)
        return {"type": "even_asphere", **radius_row(curvature), **conic, **terms}
    raise InputError(
        f"{place}: a surface of shape {kind!r} is not held "
        "(allowed: Spherical, Conic, EvenPolynomial)"
    )


def _medium(content: object, place: str) -> str:
    medium, kind = _object(content, f"{place}: 'medium'"), _class(content)
    if kind == "Air":
        return "air"
    if kind == "ModelGlass":
        return f"{number(medium, 'n', place)!r}/{number(medium, 'v', place)!r}"
    if kind == "ConstantIndex":
        return repr(number(medium, "n", place))
    maker = next((m for m in _MAKERS if kind == f"{m}Glass"), None)
    if maker is None or not medium.get("gname"):
        raise InputError(f"{place}: a medium of type {kind!r} is not held")
    try:
        return find_glass(f"{maker}:{medium['gname']}").name
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def _aperture(surface: dict[str, Any], place: str) -> dict[str, Any]:
    """Return the clear aperture that a user gave; else the surface is as large as it must be."""
    row: dict[str, Any] = {}
    for content in rows(surface.get("clear_apertures") or [], f"{place}: 'clear_apertures'"):
        aperture, kind = _object(content, f"{place}: aperture"), _class(content)
        require_unset(aperture, ("x_offset", "y_offset"), "a decentred aperture", place)
        blocks = bool(aperture.get("is_obscuration"))
        key = "obscuration" if blocks else "semi_diameter" if kind == "Circular" else "aperture"
        if key in row:
            raise InputError(f"{place}: a second aperture of one kind is not held")
        if kind == "Circular":
            radius = number(aperture, "radius", place)
            row[key] = {"semi_diameter": radius} if blocks else radius
        elif kind == "Rectangular":
            require_unset(aperture, ("rotation",), "a turned aperture", place)
            row[key] = {
                f"half_width_{axis}": number(aperture, f"{axis}_half_width", place) for axis in "xy"
            }
        else:
            raise InputError(f"{place}: an aperture of type {kind!r} is not held")
    if "semi_diameter" in row and "aperture" in row:
        raise InputError(f"{place}: a circle cut by a rectangle is not held")
    return row if row.keys() & {"semi_diameter", "aperture"} else {"semi_diameter": "auto"} | row


def _specification(model: dict[str, Any], finite: bool, where: str) -> dict[str, Any]:
    spec = _object(model.get("optical_spec"), f"{where}: 'optical_spec'")
    waves = _object(spec.get("spectral_region"), f"{where}: 'spectral_region'")
    values = [as_number(v, f"{where}: 'wavelengths'") for v in _array(waves.get("wavelengths"))]
    reference = waves.get("reference_wvl", 0)
    if not values or not isinstance(reference, int) or not 0 <= reference < len(values):
        raise InputError(f"{where}: 'reference_wvl' {reference!r} is none of the wavelengths")
    found: dict[str, Any] = {"wavelengths": values, "reference_wavelength": values[reference]}
    weights = [as_number(v, f"{where}: weights") for v in _array(waves.get("spectral_wts") or [])]
    place = f"{where}: 'spectral_wts'"
    found |= unequal_weights("wavelength_weights", weights, len(values), place)
    found |= _fields(_object(spec.get("field_of_view"), f"{where}: 'field_of_view'"), where)
    found |= _pupil(_object(spec.get("pupil"), f"{where}: 'pupil'"), finite, where)
    focus = spec.get("defocus")
    if focus is not None:
        require_unset(_object(focus, where), ("focus_shift",), "a shift of focus", where)
    return found


def _key(content: dict[str, Any]) -> tuple[str, ...]:
    words = content.get("key", content.get("_key", []))
    if not isinstance(words, list):
        return ()
    # The first of three says that they are of the aperture or the fields.
    return tuple(map(str, words[1:] if words[:1] in (["aperture"], ["field"]) else words))


def _kept(content: dict[str, Any], key: str) -> str:
    """Return the name under which a value stands: in 0.9.8 some have a line in front."""
    return f"_{key}" if f"_{key}" in content else key


def _fields(content: dict[str, Any], where: str) -> dict[str, Any]:
    key = _key(content)
    if key not in _FIELDS:
        raise InputError(f"{where}: fields of kind {' '.join(key) or 'none'} are not held")
    scale = number(content, _kept(content, "value"), where) if content.get("is_relative") else 1.0
    entries = [_object(f, f"{where}: fields") for f in rows(content.get("fields"), where)]
    found: dict[str, Any] = {
        _FIELDS[key]: [
            [scale * number(f, _kept(f, axis), where, 0.0) for axis in "xy"] for f in entries
        ]
    }
    cut = []
    for f in entries:
        row: dict[str, float] = {}
        for axis in "xy":
            upper, lower = (number(f, f"v{end}{axis}", where, 0.0) for end in "ul")
            row |= {
                f"decenter_{axis}": (lower - upper) / 2.0,
                f"compression_{axis}": (lower + upper) / 2.0,
            }
        cut.append(row)
    if any(any(row.values()) for row in cut):
        found["vignetting"] = cut
    weights = [number(f, "wt", where, 1.0) for f in entries]
    place = f"{where}: weights of the fields"
    found |= unequal_weights("weights", weights, len(entries), place)
    return {"fields": found}


def _pupil(content: dict[str, Any], finite: bool, where: str) -> dict[str, float]:
    key = _key(content)
    value = number(content, "value", where)
    if key == ("object", "epd") or key == ("object", "pupil"):
        return {"entrance_pupil_diameter": value}
    if key == ("object", "NA"):
        return {"object_na": value}
    if key == ("image", "NA") and 0.0 < value < 1.0:
        key, value = ("image", "f/#"), 1.0 / (2.0 * math.tan(math.asin(value)))
    if key == ("image", "f/#"):
        return {"working_f_number" if finite else "f_number": value}
    raise InputError(f"{where}: a pupil of kind {' '.join(key) or 'none'} is not held")


def _object(content: object, place: str) -> dict[str, Any]:
    """Return the attributes of an object of the program."""
    found = mapping(content, place)
    return mapping(found["attributes"], place) if "attributes" in found else found


def _class(content: object) -> str:
    kind = content.get("__instance_type__") if isinstance(content, dict) else None
    return str(kind[-1]) if isinstance(kind, list) and kind else ""


def _array(content: object) -> list[Any]:
    """Return the numbers of a list, or of an array of numpy."""
    if isinstance(content, dict) and "__ndarray__" in content:
        content = content["__ndarray__"]
    return content if isinstance(content, list) else []
