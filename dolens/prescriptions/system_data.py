"""The system data of a lens are its wavelengths, fields, object distance, pupil, and the air.

In a prescription, every key optional::

    wavelengths: [656.2725, 587.5618, 486.1327]   # nm
    wavelength_weights: [1, 2, 1]                 # of any sum; else all the same
    reference_wavelength: 587.5618                # nm, one of them; the first unless given
    fields: {angles: [[0, 0], [0, 20]]}           # x, y in degrees; or
    fields: {heights: [[0, 0], [0, 10]]}          # mm on an object at object_distance; or
    fields: {pupil_angles: [[0, 0], [0, 20]]}     # degrees, of the line to the entrance pupil; or
    fields: {image_heights: [[0, 0], [0, 21.6]]}  # mm on the paraxial image; or
    fields: {real_image_heights: [[0, 21.6]]}     # mm on the sensor, where real chief rays land
    object_distance: 650                          # mm in front of the first vertex; else infinity
    entrance_pupil_diameter: 20                   # mm; or
    f_number: 2.8                                 # EFL over the diameter of the entrance pupil; or
    working_f_number: 3.1                         # 1/(2n'u') of the paraxial marginal ray; or
    object_na: 0.25                               # n·sin(u) of the axial object point's edge ray
    telecentric_object: true                      # the stop's image in object space is at infinity
    temperature: 20                               # °C
    pressure: 1                                   # atm

Fields may also have `weights`, a number each, and `vignetting`, what part of the stop the beam of
each fills (`dolens.optics.fields.Vignetting`)::

    fields: {angles: [[0, 0], [0, 20]], weights: [1, 0.5],
             vignetting: [{}, {decenter_y: -0.05, compression_y: 0.3}]}

A pupil closes the stop: its semi-diameter becomes the one whose paraxial image has that diameter
at the reference wavelength, and stays what the prescription says where that is smaller.  With
`real_pupil: true` its rim is where the real marginal ray to the rim of that image crosses it.
A lens has fields by angles or by heights on the object: those that a prescription gives by the
image or the pupil are converted when the lens is built (`dolens.optics.field_and_aperture`).

The numbers that the lens's source publishes are in mm and degrees, each of them optional::

    published: {kind: Tessar, efl: 100, efl_tolerance: 0.5, f_number: 3.5, half_field: 25.7}

(see `dolens.optics.lens_data.Published`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.field_and_aperture import (
    heights_of_pupil_angles,
    in_double_precision,
    object_fields,
    real_marginal_height,
)
from dolens.optics.fields import Fields, Vignetting, require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.lens_data import Published
from dolens.optics.paraxial import matrix_to_stop, vergence
from dolens.optics.surfaces.clear_aperture import Circle, Unlimited
from dolens.prescriptions.apertures import is_automatic
from dolens.prescriptions.numbers import as_number, as_positive, require_mapping

PUPIL_KEYS = ("entrance_pupil_diameter", "f_number", "working_f_number", "object_na")
SYSTEM_DATA_KEYS = (
    "wavelengths",
    "wavelength_weights",
    "reference_wavelength",
    "fields",
    "object_distance",
    *PUPIL_KEYS,
    "telecentric_object",
    "real_pupil",
    "temperature",
    "pressure",
)
# A stop's image so many object distances away counts as infinitely far.
_TELECENTRIC = 1e4
# Files round semi-diameters: a stop that is smaller by less is what its aperture asks for.
_ROUNDED = 1e-4
# Stands for a stop's semi-diameter (mm) until the pupil decides: within any surface's sag branch.
_UNDECIDED = 1e-6
_FIELD_KINDS = ("angles", "heights", "pupil_angles", "image_heights", "real_image_heights")
_ANGLES = ("angles", "pupil_angles")
# Kinds of field points on the image, and whether real rays decide.
_BY_THE_IMAGE = {"image_heights": False, "real_image_heights": True}
PUBLISHED_KEY = "published"
_WORDS = ("kind", "note")
# All others are positive.
_SIGNED = ("magnification", "bfd")


def system_data(prescription: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the system data as arguments of `Lens`: all but the pupil.

    Fields by the image or the pupil are as the prescription has them; `set_object_fields` of
    `dolens.prescriptions.system_data` converts them.

    Raises:
        InputError: one line that names `where` and the key; two pupils are one too many.
    """
    pupils = [key for key in PUPIL_KEYS if prescription.get(key) is not None]
    if len(pupils) > 1:
        raise InputError(f"{where}: give '{pupils[0]}' or '{pupils[1]}', not both")
    wavelengths = prescription.get("wavelengths")
    if wavelengths is not None:
        if not isinstance(wavelengths, list | tuple) or not wavelengths:
            raise InputError(f"{where}: 'wavelengths' must be a list of wavelengths in nm")
        wavelengths = [as_positive(w, f"{where}: 'wavelengths'") for w in wavelengths]
        require_wavelengths(wavelengths, f"{where}: 'wavelengths'")
    reference = prescription.get("reference_wavelength")
    if reference is not None:
        reference = as_positive(reference, f"{where}: 'reference_wavelength'")
        if reference not in (wavelengths or ()):
            raise InputError(
                f"{where}: 'reference_wavelength' {reference!r} is none of 'wavelengths' "
                f"(allowed: {', '.join(map(repr, wavelengths or ())) or 'none, as none is given'})"
            )
    weights = prescription.get("wavelength_weights")
    if weights is not None:
        weights = _weights_from(weights, len(wavelengths or ()), f"{where}: 'wavelength_weights'")
    air = {}
    for key in ("temperature", "pressure"):
        value = prescription.get(key)
        air[key] = None if value is None else as_number(value, f"{where}: '{key}'")
    if air["pressure"] is not None and air["pressure"] < 0.0:
        raise InputError(f"{where}: 'pressure' must not be negative, not {air['pressure']!r}")
    telecentric = prescription.get("telecentric_object", False)
    for key in ("telecentric_object", "real_pupil"):
        if not isinstance(prescription.get(key, False), bool):
            raise InputError(f"{where}: '{key}' must be true or false")
    distance = prescription.get("object_distance")
    if distance is not None:
        distance = as_positive(distance, f"{where}: 'object_distance'")
    fields = _fields_from(prescription.get("fields"), f"{where}: fields")
    if fields is not None and fields.kind == "heights" and distance is None:
        raise InputError(f"{where}: 'fields.heights' need an 'object_distance' (mm)")
    if fields is not None and fields.kind == "angles" and vergence(distance) != 0.0:
        require_from_the_front(fields.points, f"{where}: an object at a finite distance")
    for key, needs in (("object_na", True), ("telecentric_object", telecentric)):
        if needs and prescription.get(key) and distance is None:
            raise InputError(f"{where}: '{key}' needs an 'object_distance' (mm)")
    return {
        "wavelengths": wavelengths,
        "reference_wavelength": reference,
        "fields": fields,
        "object_distance": distance,
        "wavelength_weights": weights,
        "telecentric_object": telecentric,
        **air,
    }


def system_data_of(lens: Lens) -> dict[str, Any]:
    """Return the system data of a lens as plain data; only those that it has."""
    found: dict[str, Any] = {}
    if lens.wavelengths is not None:
        found["wavelengths"] = list(lens.wavelengths)
        if lens.wavelength_weights is not None:
            found["wavelength_weights"] = list(lens.wavelength_weights)
        found["reference_wavelength"] = lens.reference_wavelength
    if lens.fields is not None:
        found["fields"] = field_rows(lens.fields)
    for key in ("object_distance", "temperature", "pressure"):
        if getattr(lens, key) is not None:
            found[key] = getattr(lens, key)
    if lens.telecentric_object:
        found["telecentric_object"] = True
    return found


def stop_row(row: Mapping[str, Any], number: int, prescription: Mapping[str, Any]) -> Any:
    """Return the row of a surface; the stop's may lack a semi-diameter where a pupil will decide
    it.
    """
    sizes = (row.get("semi_diameter"), row.get("aperture"))
    undecided = sizes == (None, None) and _pupil(prescription) is not None
    if undecided and str(prescription.get("stop", 1)) == str(number):
        return {**row, "semi_diameter": _UNDECIDED, "clips": False}
    return row


def set_stop_semi_diameter(lens: Lens, prescription: Mapping[str, Any]) -> Lens:
    """Set the stop of a new lens to the pupil that its prescription asks for, if it does.

    The paraxial pupil is proportional to the stop, so one ratio is enough; it is found in double
    precision.

    Raises:
        InputError: no stop of finite size makes this pupil, or it would exceed its surface.
    """
    key = _pupil(prescription)
    exact = in_double_precision(lens)
    if lens.telecentric_object:
        _require_telecentric(exact)
    if key is None:
        if is_automatic(_stop_of(prescription, lens.stop)):
            raise InputError(
                f"surface {lens.stop}, the stop: an automatic semi-diameter needs a pupil "
                f"({', '.join(PUPIL_KEYS)})"
            )
        return lens
    target = as_positive(prescription[key], f"'{key}'")
    surface = lens.surfaces[str(lens.stop)]
    needed = _stop_for(key, target, exact)
    if prescription.get("real_pupil", False) and math.isfinite(needed):
        needed = real_marginal_height(exact, needed)
    if not (math.isfinite(needed) and needed > 0.0):
        raise InputError(f"'{key}' {prescription[key]!r}: no size of the stop makes this pupil")
    given = _stop_of(prescription, lens.stop).get("semi_diameter")
    aperture = surface.aperture
    limited = given is not None and aperture.clips
    size = min(needed, as_number(given, "'semi_diameter'")) if limited else needed
    if size < needed * (1.0 - _ROUNDED):
        lens.stop_note = (
            f"'{key}' {target:g} asks for a stop of semi-diameter {needed:.5g} mm, and the clear "
            f"aperture of surface {lens.stop} has {size:.5g} mm: that is what these numbers are of."
        )
    edge, window = Circle(size), aperture.window
    if not isinstance(aperture.edge, Circle | Unlimited):
        # The pupil is a circle, and the stop's own outline may take light away from it.
        window = aperture.edge
    try:
        surface.aperture = replace(aperture, edge=edge, window=window)
        surface.check_aperture()
    except InputError as error:
        raise InputError(f"surface {lens.stop}: closed to '{key}', {error}") from None
    return lens


@torch.no_grad()
def _stop_for(key: str, target: float, lens: Lens) -> float:
    """Return the semi-diameter (mm) of the stop that makes a pupil in the y-z section, which is
    what pupils and F-numbers are of in Zemax, CODE V, OSLO, Optiland and ray-optics too.
    """
    wavelength, distance = lens.primary_wavelength, lens.object_distance
    if key == "object_na":
        system = lens.system().section("y")
        n = float(lens.materials[0].index(wavelength))
        if target >= n:
            raise InputError(f"'object_na' must be below the index {n:g} of the object's medium")
        slope = math.tan(math.asin(target / n))
        matrix = matrix_to_stop(system, wavelength)
        away = float(distance or 0.0)  # it is given with an aperture of the object's side
        return abs(float(matrix[0, 0]) * away + float(matrix[0, 1]) * n) * slope
    size = lens.surfaces[str(lens.stop)].semi_diameter
    first = lens.first_order(wavelength, distance, "y")
    if key == "working_f_number":
        return size * abs(float(first.working_f_number)) / target
    if key == "f_number":
        target = abs(float(first.efl)) / target
    return size * target / float(first.entrance_pupil.diameter)


@torch.no_grad()
def _require_telecentric(lens: Lens) -> None:
    pupil = float(lens.first_order(lens.primary_wavelength).entrance_pupil.z)
    if abs(pupil) < _TELECENTRIC * float(lens.object_distance or math.inf):
        raise InputError(
            "'telecentric_object': the image of the stop in object space lies at "
            f"z = {pupil:.4g} mm and not at infinity"
        )


def _pupil(prescription: Mapping[str, Any]) -> str | None:
    return next((key for key in PUPIL_KEYS if prescription.get(key) is not None), None)


def _stop_of(prescription: Mapping[str, Any], stop: int) -> Mapping[str, Any]:
    return {str(n): row for n, row in prescription["surfaces"].items()}[str(stop)]


def _fields_from(value: Any, place: str) -> Fields | None:
    """Read the fields of a prescription, of any kind; None where it has none.

    Raises:
        InputError: one line that names the key.
    """
    if value is None:
        return None
    require_mapping(value, place)
    check_keys(value, (*_FIELD_KINDS, "weights", "vignetting"), place)
    kinds = [kind for kind in _FIELD_KINDS if value.get(kind) is not None]
    if len(kinds) != 1:
        raise InputError(
            f"{place}: give one of 'angles', 'pupil_angles' (degrees), 'heights', 'image_heights' "
            "and 'real_image_heights' (mm)"
        )
    kind, points = kinds[0], value[kinds[0]]
    shape = f"{place}: '{kind}' must be a list of points [x, y]"
    if not isinstance(points, list | tuple) or not points:
        raise InputError(f"{shape}, not {points!r}")
    found = []
    for point in points:
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise InputError(f"{shape}, not {point!r}")
        x, y = (as_number(entry, f"{place}: '{kind}'") for entry in point)
        # Beyond 90° in x and y at once there is no convention of which direction is meant.
        limit = 180.0 if kind == "angles" and 0.0 in (x, y) else 90.0
        if kind in _ANGLES and max(abs(x), abs(y)) >= limit:
            along = "" if kind == "pupil_angles" else " (180 along x or y alone)"
            raise InputError(f"{place}: '{kind}' must be below 90 degrees{along}, not {point!r}")
        found.append((x, y))
    weights, vignetting = value.get("weights"), value.get("vignetting")
    if weights is not None:
        weights = tuple(_weights_from(weights, len(found), f"{place}: 'weights'"))
    if vignetting is not None:
        if not isinstance(vignetting, list | tuple) or len(vignetting) != len(found):
            raise InputError(f"{place}: 'vignetting' must be a list of {len(found)}, one a field")
        vignetting = tuple(_vignetting(one, f"{place}: 'vignetting'") for one in vignetting)
    return Fields(kind, tuple(found), weights, vignetting)


def _vignetting(value: Any, place: str) -> Vignetting:
    require_mapping(value, place)
    check_keys(value, Vignetting._fields, place)
    found = Vignetting(
        **{key: as_number(entry, f"{place}: '{key}'") for key, entry in value.items()}
    )
    if max(found.compression_x, found.compression_y) >= 1.0:
        raise InputError(f"{place}: compressions must be below 1, which leaves no light")
    return found


def _weights_from(value: Any, count: int, place: str) -> list[float]:
    """Read as many weights: numbers that are not negative, of any positive sum."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{place} must be a list of {count} numbers")
    found = [as_number(entry, place) for entry in value]
    if min(found) < 0.0 or not any(found):
        raise InputError(f"{place} must not be negative, and not all zero")
    return found


def unequal_weights(
    key: str, values: Sequence[float], count: int, place: str
) -> dict[str, list[float]]:
    """Return the weights, under a key, that a file gives its first `count` wavelengths or fields;
    nothing where it gives none, or all are the same.

    Raises:
        InputError: too few, a negative one, or zeros alone; the message begins with the place.
    """
    if not values:
        return {}
    if len(values) < count:
        raise InputError(f"{place} gives {len(values)} weights for {count}")
    found = _weights_from(list(values[:count]), count, place)
    return {key: found} if len(set(found)) > 1 else {}


def field_rows(fields: Fields) -> dict[str, Any]:
    """Return the mapping that `_fields_from` reads back."""
    rows: dict[str, Any] = {fields.kind: [list(point) for point in fields.points]}
    if fields.weights is not None:
        rows["weights"] = list(fields.weights)
    if fields.vignetting is not None:
        rows["vignetting"] = [
            {key: value for key, value in one._asdict().items() if value}
            for one in fields.vignetting
        ]
    return rows


def set_object_fields(lens: Lens) -> Lens:
    """Give a new lens the fields of the object that belong to those of its prescription.

    Raises:
        InputError: the lens forms no image, or no chief ray lands there, or the entrance pupil is
            at infinity.
    """
    fields = lens.fields
    if fields is None or fields.kind in ("angles", "heights"):
        return lens
    kind = "angles" if vergence(lens.object_distance) == 0.0 else "heights"
    points = torch.tensor(fields.points, dtype=torch.float64)
    if fields.kind in _BY_THE_IMAGE:
        points = object_fields(lens, points, _BY_THE_IMAGE[fields.kind])
    elif kind == "heights":
        points = heights_of_pupil_angles(lens, points)
    lens.fields = fields._replace(kind=kind, points=tuple((x, y) for x, y in points.tolist()))
    return lens


def published_from(value: Any, where: str) -> Published | None:
    """Read what a prescription says under `published`; None where it says nothing.

    Args:
        value: a mapping, or None.
        where: name of the prescription, for messages.

    Raises:
        InputError: one line that names the key.
    """
    if value is None:
        return None
    place = f"{where}: {PUBLISHED_KEY}"
    require_mapping(value, place)
    check_keys(value, Published._fields, place)
    found: dict[str, Any] = {}
    for key, entry in value.items():
        what = f"{place}: '{key}'"
        if entry is None:
            continue
        if key in _WORDS:
            if not isinstance(entry, str):
                raise InputError(f"{what} must be text, not {entry!r}")
            found[key] = entry
        else:
            found[key] = as_number(entry, what) if key in _SIGNED else as_positive(entry, what)
    return Published(**found)


def published_rows(published: Published | None) -> dict[str, Any]:
    """Return the keys of a prescription that `published_from` reads back; none of a lens without
    published numbers.
    """
    if published is None:
        return {}
    return {PUBLISHED_KEY: {k: v for k, v in published._asdict().items() if v is not None}}
