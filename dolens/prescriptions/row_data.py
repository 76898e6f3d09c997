"""Media, phases, coordinate breaks, elements and the sensor of a prescription, read and written.

A surface of any shape may have a phase::

    '3': {type: sphere, radius: -80, ..., phase: {type: grating, grooves: 600, order: -1}}
    '4': {type: plane, ..., phase: {type: radial, norm_radius: 10, p2: -1133.35, p4: 341.9}}
    '5': {type: plane, ..., phase: {type: xy, norm_radius: 10, x: 12.5, x2y: 3.0}}
    '6': {type: plane, ..., phase: {type: zernike_fringe, norm_radius: 10, z4: 0.5, z9: -0.1}}

`grooves` are per mm, parallel to x.  Coefficients are radians of the first order, of
(r/norm_radius)² and so on; those of Zernike polynomials are waves.  `order` is 1 and `norm_radius`
1 mm unless they are given.  `efficiency`, from 0 to 1, is data.

An ideal lens is `{type: paraxial_lens, focal_length: 100}` (mm) or has its `power` (1/mm).

A break is a row of `surfaces` with a number and a thickness of its own; angles are in degrees,
lengths in mm, and what is not written is zero::

    '3': {type: coordinate_break, tilt_x: 45, decenter_y: 2, thickness: -50}

`order: tilt_first` turns the axes before it decentres them, and so undoes a break of the opposite
numbers (see `dolens.optics.surfaces.coordinate_break`).

``elements`` maps names to groups of neighbouring surfaces; angles are in degrees, lengths in mm::

    elements:
      '1': {surfaces: [1, 2], tilt_x: 0.5, decenter_y: 0.02, pivot: [0, 0, 0]}

The pivot counts from the vertex of the element's first surface, and what is not written is zero.

The sensor stands behind the last surface::

    sensor: {distance: 96.0, diameter: 1.7664}
    sensor: {distance: 16.4, radius: -12.0, conic: 0}

`distance` is that from the last surface's vertex, mm.  A sensor with a `radius` (mm, of the sign
that a surface's has) is curved: rays end where they meet it.  `diameter` is the image circle.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.elements import DISPLACEMENTS, TILTS, Element
from dolens.optics.glass import Environment, Glass
from dolens.optics.materials import IndexModel, Medium, index_model, parse_material
from dolens.optics.parameter_names import file_value, to_lens_units
from dolens.optics.surfaces import BREAKS, PHASES, CoordinateBreak, ParaxialLens, Phase
from dolens.optics.surfaces.coordinate_break import BREAK
from dolens.prescriptions.numbers import (
    as_integer,
    as_number,
    as_positive,
    curvature_from,
    curvature_row,
    power_of,
    require_mapping,
)

# 1e-6/K: of the mount of the air gap behind a surface, or of glass whose catalogue does not say.
EXPANSION_KEY = "thermal_expansion"
PHASE_KEY = "phase"
_PHASE_KEYS = ("type", "order", "efficiency")
_DEFAULTS = {"order": 1.0, "norm_radius": 1.0}
BREAK_KIND = CoordinateBreak.kind
# A tilt that no number of degrees gives to the last bit is written in radians, under this name.
_RADIANS = tuple(f"{name}_radians" for name in TILTS)
_BREAK_KEYS = ("type", "thickness", "note", "order", *BREAK, *_RADIANS)
_OF_SURFACES = ("material", "radius", "curvature", "semi_diameter", "aperture", "obscuration")
SENSOR_KEYS = ("distance", "diameter", "radius", "curvature", "conic")


def environment_of(prescription: Mapping[str, Any], where: str) -> Environment | None:
    """Return the temperature and pressure that a prescription gives; None where it gives neither.

    Raises:
        InputError: they are no numbers, or impossible.
    """
    given = {
        key: as_number(prescription[key], f"{where}: '{key}'")
        for key in ("temperature", "pressure")
        if prescription.get(key) is not None
    }
    try:
        return Environment(**given) if given else None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def medium_of(value: object, model: IndexModel, place: str, air: Environment | None) -> Medium:
    """Return the medium that a row names, at the prescription's temperature and pressure.

    Raises:
        InputError: there is none, or it is no medium.
    """
    if value is None:
        raise InputError(f"{place}: 'material' is missing (the medium behind the surface)")
    try:
        return parse_material(str(value), model, air)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def expansion_of(row: Mapping[str, Any], medium: Medium, place: str) -> float | None:
    """Return the thermal expansion (1e-6/K) that a row gives, or None.

    Raises:
        InputError: it is no number, or the medium behind the surface has one in its catalogue.
    """
    rate = row.get(EXPANSION_KEY)
    if rate is None:
        return None
    own = catalogue_expansion(medium)
    if own is not None:
        raise InputError(
            f"{place}: '{EXPANSION_KEY}' is that of a mount, or of glass whose catalogue does not "
            f"say; {medium.name} has {1e6 * own:g} there"
        )
    return as_number(rate, f"{place}: '{EXPANSION_KEY}'")


def catalogue_expansion(medium: Medium) -> float | None:
    """Return the thermal expansion (1/K) that a medium's catalogue gives, or None."""
    return medium.expansion if isinstance(medium, Glass) else None


def canonical(material: str) -> str:
    """Return one name for a medium in another program's file, in which `occluder` is air; unchanged
    if none.
    """
    try:
        name = parse_material(material, index_model("dfc")).name
    except InputError:
        return material
    return "air" if name == "occluder" else name


def canonical_digits(material: str) -> str:
    """Return the same, with the numbers of nd/Vd and nd/Vd/ΔPgF as their shortest digits."""
    name = canonical(material)
    parts = name.split("/")
    try:
        return "/".join(repr(float(part)) for part in parts) if len(parts) > 1 else name
    except ValueError:
        return name


def phase_from(value: object, place: str, dtype: torch.dtype) -> Phase:
    """Build the phase of a surface from a prescription.

    Raises:
        InputError: one line that names the place, the key, and what is allowed.
    """
    where = f"{place}: phase"
    require_mapping(value, where)
    row: Mapping[str, Any] = value  # type: ignore[assignment]
    kind = str(row.get("type"))
    check_choice(kind, PHASES, f"{where}: type")
    try:
        names = PHASES[kind].parameter_names(row)
        check_keys(row, (*_PHASE_KEYS, *names), where)
        values = {
            name: as_number(row.get(name, _DEFAULTS.get(name)), f"'{name}'") for name in names
        }
        values["order"] = as_integer(values["order"], "'order'")
        if "norm_radius" in values:
            as_positive(values["norm_radius"], "'norm_radius'")
        efficiency = row.get("efficiency")
        if efficiency is not None:
            efficiency = as_number(efficiency, "'efficiency'")
        return PHASES[kind](values, dtype, efficiency)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(where) else f"{where}: {message}") from None


def phase_row(phase: Phase) -> dict[str, Any]:
    """Return a phase as a prescription writes it."""
    stored = {**dict(phase.named_buffers()), **dict(phase.named_parameters())}
    row: dict[str, Any] = {"type": phase.type}
    row |= {name: value.detach().tolist() for name, value in stored.items()}
    row["order"] = int(row["order"])
    return row if phase.efficiency is None else {**row, "efficiency": phase.efficiency}


def with_power(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a paraxial lens's row with `power` in the place of `focal_length`.

    Raises:
        InputError: both are given, or a focal length of zero.
    """
    if row.get("focal_length") is None:
        return row
    if row.get("power") is not None:
        raise InputError("give 'focal_length' or 'power', not both")
    return {**without(row, "focal_length"), "power": power_of(row["focal_length"])}


def power_row(power: float) -> dict[str, float]:
    """Return `focal_length`, or `power` where rounding of 1/(1/φ) would lose a bit."""
    length = math.inf if power == 0.0 else 1.0 / power
    return {"focal_length": length} if 1.0 / length == power else {"power": power}


def is_paraxial_lens(row: Mapping[str, Any]) -> bool:
    """Return whether a row is a paraxial lens."""
    return str(row.get("type")) == ParaxialLens.kind


def without(row: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return a row without one key."""
    return {name: value for name, value in row.items() if name != key}


def is_break(row: Mapping[str, Any]) -> bool:
    """Return whether a row of a prescription is a coordinate break."""
    return row.get("type") == BREAK_KIND


def break_from(row: Mapping[str, Any], place: str, dtype: torch.dtype) -> CoordinateBreak:
    """Read a coordinate break.

    Raises:
        InputError: one line that names `place` and the key.
    """
    for key in _OF_SURFACES:
        if row.get(key) is not None:
            raise InputError(f"{place}: a coordinate break has no '{key}': light does not meet it")
    check_keys(row, _BREAK_KEYS, place)
    order = str(row.get("order", CoordinateBreak.order))
    check_choice(order, BREAKS, f"{place}: 'order'")
    return BREAKS[order](_pose(row, BREAK, place), dtype)


def break_row(surface: CoordinateBreak) -> dict[str, Any]:
    """Return the row that `break_from` reads back to the same parameters, to the last bit."""
    row: dict[str, Any] = {"type": BREAK_KIND, **_pose_row(surface)}
    if surface.order != CoordinateBreak.order:
        row["order"] = surface.order
    return row


def elements_from(value: Any, dtype: torch.dtype, where: str) -> dict[str, Element]:
    """Read the elements of a prescription.

    Raises:
        InputError: one line that names the element and the key.
    """
    if value is None:
        return {}
    require_mapping(value, f"{where}: 'elements'")
    return {
        str(name): _element(row, dtype, f"{where}: element {name}") for name, row in value.items()
    }


def element_rows(elements: Mapping[str, Element]) -> dict[str, dict[str, Any]]:
    """Return rows that `elements_from` reads back to the same parameters, to the last bit."""
    rows = {}
    for name, element in elements.items():
        row: dict[str, Any] = {"surfaces": [element.first, element.last], **_pose_row(element)}
        if any(element.pivot):
            row["pivot"] = list(element.pivot)
        rows[name] = row
    return rows


def _element(row: Any, dtype: torch.dtype, place: str) -> Element:
    require_mapping(row, place)
    check_keys(row, ("surfaces", *TILTS, *DISPLACEMENTS, "pivot", *_RADIANS), place)
    surfaces, pivot = row.get("surfaces"), row.get("pivot", (0.0, 0.0, 0.0))
    if not isinstance(surfaces, list | tuple) or len(surfaces) != 2:
        raise InputError(f"{place}: 'surfaces' must be [first, last], not {surfaces!r}")
    if not isinstance(pivot, list | tuple) or len(pivot) != 3:
        raise InputError(f"{place}: 'pivot' must be [x, y, z] in mm, not {pivot!r}")
    pose = _pose(row, (*TILTS, *DISPLACEMENTS), place)
    try:
        return Element(
            as_integer(surfaces[0], "'surfaces'"),
            as_integer(surfaces[1], "'surfaces'"),
            pose,
            [as_number(entry, "'pivot'") for entry in pivot],
            dtype,
        )
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def _pose(row: Mapping[str, Any], names: Iterable[str], place: str) -> dict[str, float]:
    """Return tilts (radians) and decenters (mm) of a row; what it does not say is zero."""
    found = {}
    for name in names:
        radians = f"{name}_radians"
        if name in row and radians in row:
            raise InputError(f"{place}: give '{name}' or '{radians}', not both")
        found[name] = to_lens_units(name, as_number(row.get(name, 0.0), f"{place}: '{name}'"))
        if radians in row:
            found[name] = as_number(row[radians], f"{place}: '{radians}'")
    return found


def _pose_row(moved: torch.nn.Module) -> dict[str, float]:
    """Return the numbers that `_pose` reads back, of all that are not zero."""
    row: dict[str, float] = {}
    for name, value in moved.named_parameters():
        number = float(value.detach())
        written = file_value(name, number)
        if number != 0.0:
            row |= {f"{name}_radians": number} if written is None else {name: written}
    return row


def sensor_from(prescription: Mapping[str, Any], where: str) -> dict[str, float | None]:
    """Return the arguments of `Lens` that the sensor of a prescription gives.

    Raises:
        InputError: one line that names `where` and the key.
    """
    sensor = prescription.get("sensor")
    if not isinstance(sensor, Mapping) or "distance" not in sensor:
        raise InputError(f"{where}: 'sensor.distance' is missing (mm from the last surface)")
    check_keys(sensor, SENSOR_KEYS, f"{where}: sensor")
    found: dict[str, float | None] = {
        "sensor_distance": as_number(sensor["distance"], f"{where}: 'sensor.distance'"),
        "sensor_diameter": None,
    }
    if sensor.get("diameter") is not None:
        found["sensor_diameter"] = as_number(sensor["diameter"], f"{where}: 'sensor.diameter'")
    if any(sensor.get(key) is not None for key in ("radius", "curvature", "conic")):
        try:
            found["sensor_curvature"] = curvature_from(sensor, "curvature")
        except InputError as error:
            raise InputError(f"{where}: sensor: {error}") from None
    if sensor.get("conic") is not None:
        found["sensor_conic"] = as_number(sensor["conic"], f"{where}: 'sensor.conic'")
    return found


def sensor_row(lens: Any) -> dict[str, float]:
    """Return the sensor of a lens as a prescription writes it."""
    row = {"distance": float(lens.sensor_distance.detach())}
    if lens.sensor_diameter is not None:
        row["diameter"] = lens.sensor_diameter
    if lens.sensor_curvature is not None:
        row |= curvature_row("curvature", float(lens.sensor_curvature.detach()))
    if lens.sensor_conic is not None:
        row["conic"] = float(lens.sensor_conic.detach())
    return row
