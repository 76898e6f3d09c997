"""The system data of a lens are its wavelengths, fields, object distance and pupil.

In a prescription, every key optional::

    wavelengths: [656.2725, 587.5618, 486.1327]   # nm
    reference_wavelength: 587.5618                # nm, one of them; the first unless given
    fields: {angles: [[0, 0], [0, 20]]}           # x, y in degrees
    fields: {heights: [[0, 0], [0, 10]]}          # or x, y in mm on an object at object_distance
    object_distance: 650                          # mm in front of the first vertex; else infinity
    entrance_pupil_diameter: 20                   # mm; or
    f_number: 2.8                                 # EFL over the diameter of the entrance pupil
    temperature: 20                               # °C
    pressure: 1                                   # atm

A pupil closes the stop: its semi-diameter becomes the one whose paraxial image has that diameter
at the reference wavelength, and stays what the prescription says where that is smaller.
"""

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.optics.fields import Fields
from dolens.optics.lens import Lens
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optics.thermal import Environment
from dolens.prescriptions.checks import as_number, as_positive, require_mapping

PUPIL_KEYS = ("entrance_pupil_diameter", "f_number")
SYSTEM_DATA_KEYS = (
    "wavelengths",
    "reference_wavelength",
    "fields",
    "object_distance",
    *PUPIL_KEYS,
    "temperature",
    "pressure",
)
_FIELD_KINDS = ("angles", "heights")
# Stands for a stop's semi-diameter (mm) until the pupil decides: within any surface's sag branch.
_UNDECIDED = 1e-6


def system_data(prescription: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the system data as arguments of `Lens`: wavelengths, fields and object distance.

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
    reference = prescription.get("reference_wavelength")
    if reference is not None:
        reference = as_positive(reference, f"{where}: 'reference_wavelength'")
        if reference not in (wavelengths or ()):
            raise InputError(
                f"{where}: 'reference_wavelength' {reference!r} is none of 'wavelengths' "
                f"(allowed: {', '.join(map(repr, wavelengths or ())) or 'none, as none is given'})"
            )
    distance = prescription.get("object_distance")
    if distance is not None:
        distance = as_number(distance, f"{where}: 'object_distance'")
    fields = _fields(prescription.get("fields"), f"{where}: fields")
    if fields is not None and fields.kind == "heights" and distance is None:
        raise InputError(f"{where}: 'fields.heights' need an 'object_distance' (mm)")
    return {
        "wavelengths": wavelengths,
        "reference_wavelength": reference,
        "fields": fields,
        "object_distance": distance,
        **_surroundings(prescription, where),
    }


def system_data_of(lens: Lens) -> dict[str, Any]:
    """Return the system data of a lens as plain data; only those that it has."""
    found: dict[str, Any] = {}
    if lens.wavelengths is not None:
        found["wavelengths"] = list(lens.wavelengths)
        found["reference_wavelength"] = lens.reference_wavelength
    if lens.fields is not None:
        found["fields"] = {lens.fields.kind: [list(point) for point in lens.fields.points]}
    for key in ("object_distance", "temperature", "pressure"):
        if getattr(lens, key) is not None:
            found[key] = getattr(lens, key)
    return found


def environment_of(prescription: Mapping[str, Any], where: str) -> Environment | None:
    """Return the temperature and pressure that a prescription gives; None where it gives neither.

    Raises:
        InputError: they are no numbers, or impossible.
    """
    given = {key: v for key, v in _surroundings(prescription, where).items() if v is not None}
    try:
        return Environment(**given) if given else None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _surroundings(prescription: Mapping[str, Any], where: str) -> dict[str, float | None]:
    values = {key: prescription.get(key) for key in ("temperature", "pressure")}
    return {
        key: None if value is None else as_number(value, f"{where}: '{key}'")
        for key, value in values.items()
    }


def stop_row(row: Mapping[str, Any], number: int, prescription: Mapping[str, Any]) -> Any:
    """Return the row of a surface; the stop's may lack a semi-diameter where a pupil will decide
    it.
    """
    sizes = (row.get("semi_diameter"), row.get("aperture"))
    undecided = sizes == (None, None) and _pupil(prescription) is not None
    if undecided and str(prescription.get("stop", 1)) == str(number):
        return {**row, "semi_diameter": _UNDECIDED}
    return row


def set_stop_semi_diameter(lens: Lens, prescription: Mapping[str, Any]) -> Lens:
    """Set the stop of a new lens to the pupil that its prescription asks for, if it does.

    The paraxial pupil is proportional to the stop, so one ratio is enough; it is found in double
    precision.

    Raises:
        InputError: no stop of finite size makes this pupil, or it would exceed its surface.
    """
    key = _pupil(prescription)
    if key is None:
        return lens
    target = as_positive(prescription[key], f"'{key}'")
    with torch.no_grad():
        exact = copy.deepcopy(lens).to(torch.float64)
        first = exact.first_order(lens.primary_wavelength)
    if key == "f_number":
        target = abs(float(first.efl)) / target
    surface = lens.surfaces[str(lens.stop)]
    needed = surface.semi_diameter * target / float(first.entrance_pupil.diameter)
    if not (math.isfinite(needed) and needed > 0.0):
        raise InputError(f"'{key}' {prescription[key]!r}: no size of the stop makes this pupil")
    given = _stop_of(prescription, lens.stop).get("semi_diameter")
    if not isinstance(surface.aperture.edge, Circle):
        raise InputError(f"'{key}' closes a circular stop; surface {lens.stop} is a rectangle")
    size = needed if given is None else min(needed, surface.semi_diameter)
    try:
        surface.aperture = ClearAperture(Circle(size), surface.aperture.obscuration)
        surface.check_aperture()
    except InputError as error:
        raise InputError(f"surface {lens.stop}: closed to '{key}', {error}") from None
    return lens


def _pupil(prescription: Mapping[str, Any]) -> str | None:
    return next((key for key in PUPIL_KEYS if prescription.get(key) is not None), None)


def _stop_of(prescription: Mapping[str, Any], stop: int) -> Mapping[str, Any]:
    return {str(n): row for n, row in prescription["surfaces"].items()}[str(stop)]


def _fields(value: Any, place: str) -> Fields | None:
    if value is None:
        return None
    require_mapping(value, place)
    check_keys(value, _FIELD_KINDS, place)
    if len(value) != 1:
        raise InputError(f"{place}: give 'angles' (degrees) or 'heights' (mm)")
    kind, points = next(iter(value.items()))
    shape = f"{place}: '{kind}' must be a list of points [x, y]"
    if not isinstance(points, list | tuple) or not points:
        raise InputError(f"{shape}, not {points!r}")
    found = []
    for point in points:
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise InputError(f"{shape}, not {point!r}")
        x, y = (as_number(entry, f"{place}: '{kind}'") for entry in point)
        if kind == "angles" and max(abs(x), abs(y)) >= 90.0:
            raise InputError(f"{place}: 'angles' must be below 90 degrees, not {point!r}")
        found.append((x, y))
    return Fields(str(kind), tuple(found))
