"""States of one lens are read from a prescription and written to it.

A state is a partial prescription that is laid over the lens: zoom, focus, temperature::

    states:
      wide: {surfaces: {'5': {thickness: 2.0}}, sensor: {distance: 12}, published: {efl: 20}}
      near: {object_distance: 500, surfaces: {'5': {thickness: 4.5}}, fields: {heights: [[0, 0]]}}
      hot: {temperature: 60}

It may say numbers of surfaces (thickness, radius, conic, coefficients, clear aperture; tilts and
decenters of a coordinate break), `sensor.distance`, `object_distance` (`.inf` for infinity),
fields, wavelengths, one aperture key such as `f_number`, and what the source publishes of it.
What it does not say is the lens's, the F-number too; `f_number: null` leaves the stop as wide as
it is in the lens, as a lens has it that is focused.  `wavelength_weights` and
`reference_wavelength` alone are of the lens's wavelengths; `wavelengths` bring their own with them.
`temperature` and `pressure` heat the lens, as `Lens.at` does.
What changes the structure, as a type, a glass or the stop, is refused: that is another lens.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.glass import STANDARD_PRESSURE, STANDARD_TEMPERATURE, Environment
from dolens.optics.lens import Lens
from dolens.optics.lens_states import (
    LensState,
    LensStates,
    StateData,
    overlaid,
    state_of_difference,
)
from dolens.prescriptions.apertures import (
    APERTURE_KEYS,
    aperture_rows,
    is_automatic,
    set_common_semi_diameters,
)
from dolens.prescriptions.numbers import as_number, require_mapping
from dolens.prescriptions.system_data import PUBLISHED_KEY, PUPIL_KEYS, field_rows, published_rows

STATES_KEY = "states"
MOST_STATES = 100
# Surfaces of the lenses in all states together: so many are built in seconds.
_MOST_SURFACES = 10_000
_WAVES = ("wavelengths", "reference_wavelength", "wavelength_weights")
_AIR = ("temperature", "pressure")
_DATA = ("fields", "object_distance", *_WAVES, *PUPIL_KEYS, PUBLISHED_KEY)
_KEYS = ("surfaces", "sensor", *_DATA, *_AIR)
# What a row of a surface says that is no number of it.
_STRUCTURE = (
    "type",
    "material",
    "phase",
    "coating",
    "diffractive",
    "thermal_expansion",
    "note",
    "order",
)
_RADIANS = "_radians"

Build = Callable[[Mapping[str, Any], str], Lens]


def with_states(lens: Lens, prescription: Mapping[str, Any], build: Build, where: str) -> Lens:
    """Give a new lens the states of its prescription.

    An automatic semi-diameter becomes the largest over the lens and all its states.

    Args:
        lens: built from the prescription without its states.
        prescription: as it is written.
        build: makes a lens of a prescription, given its name in messages.
        where: name of the prescription in messages.

    Raises:
        InputError: one line that names the state, the surface and the key.
    """
    given = prescription[STATES_KEY]
    require_mapping(given, f"{where}: {STATES_KEY}")
    most = min(MOST_STATES, _MOST_SURFACES // len(lens.surfaces))
    if len(given) > most:
        raise InputError(
            f"{where}: has {len(given)} states; a lens of {len(lens.surfaces)} surfaces has {most} "
            "at most"
        )
    others: dict[str, Lens] = {}
    owned: dict[str, list[str]] = {}
    for name, overlay in given.items():
        place = f"{where}: state '{name}'"
        if not str(name).replace("_", "").replace("-", "").isalnum():
            raise InputError(f"{place}: its name has letters, digits, '_' and '-' only")
        overlay = {} if overlay is None else overlay
        owned[str(name)] = _own_parameters(lens, overlay, place)
        whole = merged_prescription(prescription, overlay, place)
        if any(key in overlay and overlay[key] is None for key in PUPIL_KEYS):
            number = str(lens.stop)
            stop = aperture_rows(lens.surfaces[number].aperture)
            whole["surfaces"][number] |= {"clips": True, **stop}
        others[str(name)] = build(whole, place)
    rows = {str(n): row for n, row in prescription["surfaces"].items()}
    automatic = [n for n, row in rows.items() if is_automatic(row) and n != str(lens.stop)]
    set_common_semi_diameters([lens, *others.values()], automatic)
    states: dict[str, LensState] = {}
    for name, other in others.items():
        data = StateData(**_air(lens, given[name] or {}, f"{where}: state '{name}'"))
        states[name] = state_of_difference(lens, other, owned[name], data)
    lens.states = LensStates(states)
    return lens


def state_rows(lens: Lens, rows_of: Callable[[Lens], Mapping[str, Any]]) -> dict[str, Any]:
    """Return the key of a prescription that `with_states` reads back; none of a lens without
    states.

    Args:
        lens: the lens.
        rows_of: returns the prescription of a lens without states.
    """
    found = {name: _state_row(lens, name, rows_of) for name in lens.state_names}
    return {STATES_KEY: found} if found else {}


def _state_row(
    lens: Lens, name: str, rows_of: Callable[[Lens], Mapping[str, Any]]
) -> dict[str, Any]:
    state, there = lens.states[name], overlaid(lens, name)
    whole, data = rows_of(there), state.data
    own = {parameter for parameter, _ in state.named_parameters()}
    surfaces: dict[str, dict[str, Any]] = {}
    for n, row in whole["surfaces"].items():
        kept = {key: value for key, value in row.items() if _parameter(n, key) in own}
        if n in data.apertures:
            kept |= aperture_rows(data.apertures[n])
            if data.apertures[n].clips and not lens.surfaces[n].aperture.clips:
                kept["clips"] = True
        if kept:
            surfaces[n] = kept
    found: dict[str, Any] = {"surfaces": surfaces} if surfaces else {}
    if "sensor_distance" in own:
        found["sensor"] = {"distance": whole["sensor"]["distance"]}
    # What is noted of a stop follows from its numbers.
    given = {key: value for key, value in data.given.items() if key != "stop_note"}
    if "wavelengths" in given:
        waves = {key: getattr(there, key) for key in _WAVES}
        given |= {key: value for key, value in waves.items() if value is not None}
    for key, value in given.items():
        if key == "fields":
            found[key] = field_rows(value)
        elif key == PUBLISHED_KEY:
            found |= published_rows(value)
        elif key == "object_distance":
            found[key] = math.inf if value is None else value
        else:
            found[key] = list(value) if isinstance(value, tuple) else value
    for key in _AIR:
        if getattr(data, key) is not None:
            found[key] = getattr(data, key)
    return found


def _parameter(number: str, key: str) -> str:
    """Return the name in a lens of the parameter that a key of a surface's row gives."""
    if key == "thickness":
        return f"thicknesses.{number}"
    if key == "focal_length":
        return f"surfaces.{number}.power"
    last = key.removesuffix(_RADIANS).replace("radius", "curvature")
    # Not of an outline: `norm_radius` is a parameter by its own name.
    return f"surfaces.{number}.{last if key.startswith('radius') else key.removesuffix(_RADIANS)}"


def _own_parameters(lens: Lens, overlay: Any, place: str) -> list[str]:
    """Return the names of the parameters that a state says."""
    require_mapping(overlay, place)
    check_keys(overlay, _KEYS, place)
    found = []
    rows, sensor = overlay.get("surfaces") or {}, overlay.get("sensor") or {}
    require_mapping(rows, f"{place}: surfaces")
    require_mapping(sensor, f"{place}: sensor")
    for number, row in rows.items():
        where = f"{place}: surface {number}"
        if str(number) not in lens.surfaces:
            raise InputError(f"{where} is not in the lens, which has 1 to {len(lens.surfaces)}")
        require_mapping(row, where)
        surface = lens.surfaces[str(number)]
        for key in map(str, row):
            if key in APERTURE_KEYS:
                continue
            name = _parameter(str(number), key)
            known = (
                name == f"thicknesses.{number}" or name.rpartition(".")[2] in surface._parameters
            )
            if key in _STRUCTURE or not known:
                raise InputError(
                    f"{where}: a state cannot change '{key}'; it has numbers of surfaces: "
                    f"thickness, {', '.join(surface._parameters)}, semi_diameter"
                )
            found.append(name)
    check_keys(sensor, ("distance",), f"{place}: sensor")
    return [*found, *(["sensor_distance"] if sensor else [])]


def merged_prescription(
    prescription: Mapping[str, Any], overlay: Any, place: str
) -> dict[str, Any]:
    """Return the whole prescription of a state, but for its temperature and pressure.

    Args:
        prescription: of the lens; its states are left out.
        overlay: the state.
        place: its name in messages.
    """
    found = {key: value for key, value in prescription.items() if key != STATES_KEY}
    if any(key in overlay for key in PUPIL_KEYS):
        found = {key: value for key, value in found.items() if key not in PUPIL_KEYS}
    if "wavelengths" in overlay:
        # Weights and a reference of other wavelengths say nothing of these.
        found = {key: value for key, value in found.items() if key not in _WAVES}
    found |= {key: overlay[key] for key in _DATA if key in overlay}
    distance = found.get("object_distance")
    if (
        distance is not None
        and as_number(distance, f"{place}: 'object_distance'", False) == math.inf
    ):
        del found["object_distance"]
    rows = {str(n): dict(row) for n, row in prescription["surfaces"].items()}
    for n, row in (overlay.get("surfaces") or {}).items():
        known = rows[str(n)]
        for key in row:
            # A radius instead of a curvature, degrees instead of radians, or the other way.
            said = _parameter(str(n), str(key))
            for other in [k for k in known if k != key and _parameter(str(n), k) == said]:
                del known[other]
        known |= {str(key): value for key, value in row.items()}
    found["surfaces"] = rows
    found["sensor"] = {**prescription["sensor"], **(overlay.get("sensor") or {})}
    return found


def _air(lens: Lens, overlay: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return the temperature and pressure that a state says."""
    found = {
        key: as_number(overlay[key], f"{place}: '{key}'")
        for key in _AIR
        if overlay.get(key) is not None
    }
    own = (lens.temperature, lens.pressure)
    standard = (STANDARD_TEMPERATURE, STANDARD_PRESSURE)
    values = [
        found.get(key, other if given is None else given)
        for key, given, other in zip(_AIR, own, standard, strict=True)
    ]
    try:
        Environment(*values)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    return found
