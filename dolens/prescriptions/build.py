"""From a prescription (plain data) to a lens, and back.

A prescription is a mapping::

    name: Wavefront coding
    index_model: dfc            # dfc | do | paper
    stop: 1                     # number of the stop surface
    surfaces:
      '1': {type: sphere, radius: 63, semi_diameter: 6.35, thickness: 4, material: 1.51680/64.17}
      '2': ...                  # the last surface has no thickness
    sensor: {distance: 96.0, diameter: 1.7664}

Lengths are in mm; `radius: .inf` is a plane; `material` is the medium behind the surface.
What the lens is used with is optional: `wavelengths`, `fields`, `object_distance`, and a pupil
that the stop is closed to (see `dolens.prescriptions.conditions`).
It is data: nothing in it names code, and unknown keys are errors.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import index_model as find_index_model
from dolens.optics.materials import parse_material
from dolens.optics.surfaces import SURFACES, Surface
from dolens.prescriptions.checks import check_keys as _check_keys
from dolens.prescriptions.checks import integer as _integer
from dolens.prescriptions.checks import near as _near
from dolens.prescriptions.checks import number as _number
from dolens.prescriptions.checks import numbers as _numbers
from dolens.prescriptions.checks import require_mapping as _require_mapping
from dolens.prescriptions.conditions import (
    CONDITION_KEYS,
    close_stop,
    conditions,
    conditions_of,
    stop_row,
)

_LENS_KEYS = (
    *("name", "source", "index_model", "stop", "object_material", "surfaces", "sensor"),
    *CONDITION_KEYS,
)
_SURFACE_KEYS = ("type", "radius", "semi_diameter", "thickness", "material", "note")
_SENSOR_KEYS = ("distance", "diameter")


def lens_from_prescription(
    prescription: Mapping[str, Any],
    dtype: torch.dtype = torch.float64,
    index_model: str | None = None,
    where: str = "lens",
) -> Lens:
    """Build a lens from plain data.

    Args:
        prescription: as the module's docstring shows.
        dtype: precision of the lens.
        index_model: used instead of the prescription's own.
        where: what messages call this prescription, usually its file.

    Raises:
        InputError: one line that names `where`, the surface and the key.
    """
    _require_mapping(prescription, where)
    _check_keys(prescription, _LENS_KEYS, where)
    name = str(prescription.get("name", where))
    try:
        model = find_index_model(index_model or str(prescription.get("index_model", "dfc")))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    rows = _rows(prescription, where)
    sensor = prescription.get("sensor")
    if not isinstance(sensor, Mapping) or "distance" not in sensor:
        raise InputError(f"{where}: 'sensor.distance' is missing (mm from the last surface)")
    _check_keys(sensor, _SENSOR_KEYS, f"{where}: sensor")
    used_with = conditions(prescription, where)
    surfaces, thicknesses = [], []
    materials = [_material(prescription.get("object_material", "air"), model, f"{where}: object")]
    for number, row in enumerate(rows, 1):
        place = f"{where}: surface {number}"
        surfaces.append(_surface(stop_row(row, number, prescription), place, dtype))
        materials.append(_material(row.get("material"), model, place))
        if number < len(rows):
            if row.get("thickness") is None:
                raise InputError(f"{place}: 'thickness' is missing (mm to surface {number + 1})")
            thicknesses.append(_number(row["thickness"], f"{place}: 'thickness'"))
        elif row.get("thickness") is not None:
            raise InputError(
                f"{place}: the last surface has no 'thickness'; its gap is 'sensor.distance'"
            )
    diameter = sensor.get("diameter")
    try:
        lens = Lens(
            surfaces,
            thicknesses,
            _number(sensor["distance"], f"{where}: 'sensor.distance'"),
            materials,
            _integer(prescription.get("stop", 1), f"{where}: 'stop'"),
            model.name,
            name,
            None if diameter is None else _number(diameter, f"{where}: 'sensor.diameter'"),
            dtype,
            **used_with,
        )
        return close_stop(lens, prescription)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def prescription_of(lens: Lens) -> dict[str, Any]:
    """The prescription of a lens as it stands now: plain numbers and strings, ready for YAML.

    Reading it back gives a lens with the same parameters to the last bit.
    """
    rows: dict[str, dict[str, Any]] = {}
    for (number, surface), material in zip(lens.surfaces.items(), lens.materials[1:], strict=True):
        row: dict[str, Any] = {"type": surface.kind}
        for key, value in (*surface.named_parameters(), *surface.named_buffers()):
            number_value = value.detach().tolist()
            if key == "curvature":
                row["radius"] = _radius(number_value)
                if 1.0 / row["radius"] != number_value:
                    # Rounding of 1/(1/c) loses a bit for some c: keep the parameter itself.
                    del row["radius"]
                    row["curvature"] = number_value
            else:
                row[key] = number_value
        row["semi_diameter"] = surface.semi_diameter
        if number in lens.thicknesses:
            row["thickness"] = float(lens.thicknesses[number].detach())
        row["material"] = material.name
        rows[number] = row
    sensor: dict[str, Any] = {"distance": float(lens.sensor_distance.detach())}
    if lens.sensor_diameter is not None:
        sensor["diameter"] = lens.sensor_diameter
    return {
        "name": lens.name,
        "index_model": lens.index_model,
        "stop": lens.stop,
        "object_material": lens.materials[0].name,
        **conditions_of(lens),
        "surfaces": rows,
        "sensor": sensor,
    }


def _surface(row: Mapping[str, Any], place: str, dtype: torch.dtype) -> Surface:
    kind = str(row.get("type", "sphere"))
    if kind not in SURFACES:
        raise InputError(
            f"{place}: type '{kind}' is unknown{_near(kind, SURFACES)} "
            f"(allowed: {', '.join(SURFACES)})"
        )
    shape = SURFACES[kind]
    if row.get("semi_diameter") is None:
        raise InputError(f"{place}: 'semi_diameter' is missing (mm)")
    try:
        names = shape.parameter_names(row)
        _check_keys(row, (*_SURFACE_KEYS, *names), place)
        values = {key: _numbers(row.get(key, 0.0), f"'{key}'") for key in names}
        if "curvature" in names:
            values["curvature"] = _curvature(row)
        elif not math.isinf(_number(row.get("radius", math.inf), "'radius'")):
            raise InputError(f"a surface of type '{kind}' has no 'radius'")
        semi_diameter = _number(row["semi_diameter"], "'semi_diameter'")
        return shape(semi_diameter, values, dtype)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(place) else f"{place}: {message}") from None


def _curvature(row: Mapping[str, Any]) -> float:
    if row.get("curvature") is not None and row.get("radius") is not None:
        raise InputError("give 'radius' or 'curvature', not both")
    if row.get("curvature") is not None:
        return _number(row["curvature"], "'curvature'")
    if row.get("radius") is None:
        raise InputError("'radius' is missing (mm; .inf for a plane)")
    radius = _number(row["radius"], "'radius'", finite=False)
    if radius == 0.0:
        raise InputError("'radius' is 0; write .inf for a plane")
    return 1.0 / radius


def _radius(curvature: float) -> float:
    return math.inf if curvature == 0.0 else 1.0 / curvature


def _rows(prescription: Mapping[str, Any], where: str) -> list[Mapping[str, Any]]:
    surfaces = prescription.get("surfaces")
    if not isinstance(surfaces, Mapping) or not surfaces:
        raise InputError(f"{where}: 'surfaces' must map surface numbers from 1 to surfaces")
    rows = {str(number): row for number, row in surfaces.items()}
    for number in range(1, len(rows) + 1):
        if str(number) not in rows:
            raise InputError(
                f"{where}: surface {number} is missing; surfaces are numbered 1 to {len(rows)} "
                f"without gaps, not {', '.join(rows)}"
            )
        _require_mapping(rows[str(number)], f"{where}: surface {number}")
    return [rows[str(number)] for number in range(1, len(rows) + 1)]


def _material(value: object, model: Any, place: str) -> Any:
    if value is None:
        raise InputError(f"{place}: 'material' is missing (the medium behind the surface)")
    try:
        return parse_material(str(value), model)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
