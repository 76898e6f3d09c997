"""A lens is built from a prescription (plain data), and written as one.

A prescription is a mapping::

    name: Wavefront coding
    index_model: dfc            # dfc | do | paper
    stop: 1                     # number of the stop surface
    surfaces:
      '1': {type: sphere, radius: 63, semi_diameter: 6.35, thickness: 4, material: 1.51680/64.17}
      '2': ...                  # the last surface has no thickness
    elements:                   # optional, see row_data.py; rectangular apertures: see apertures.py
      '1': {surfaces: [1, 3], tilt_x: 0.1, decenter_y: 0.02}
    sensor: {distance: 96.0, diameter: 1.7664}   # curved: see row_data.py

Lengths are in mm; `radius: .inf` is a plane (some shapes have `radius_x` and `radius_y`);
`material` is the medium behind the surface: `air`, `occluder`, a constant index (`1.5`), glass as
nd/Vd or nd/Vd/ΔPgF, or by catalogue (`N-BK7`, `OHARA:S-BSL7`).
`material: mirror` makes the surface reflect; behind it light travels towards -z, and thicknesses
are negative until the next mirror.  Rows of type `coordinate_break` move and turn the axes of all
that stands behind them (see row_data.py).
A surface may have a `phase`, a grating or a diffractive lens, and a `paraxial_lens` is an ideal
lens (see row_data.py).  Which share of the light passes is said by its `coating` (see coatings.py).
A surface may be a `diffractive` element, whose relief waves see (see diffractive.py).
`thermal_expansion` (1e-6/K) is that of the mount of an air gap (see `dolens.optics.thermal_lens`).
Some shapes have lists of numbers (the coefficients and knots of a `b_spline`).
What the lens is used with is optional: `wavelengths`, `fields`, `object_distance`, and a pupil
that the stop is closed to (see `dolens.prescriptions.system_data`).
So are the numbers that its source publishes, and the states of a lens that zooms, focuses or gets
warm (see `dolens.prescriptions.states`).
It is data: nothing in it names code, and unknown keys are errors.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_keys, did_you_mean
from dolens.optics.lens import Lens
from dolens.optics.materials import index_model as find_index_model
from dolens.optics.materials import media_of
from dolens.optics.surfaces import SURFACES, Surface
from dolens.optics.surfaces.coordinate_break import CoordinateBreak
from dolens.prescriptions.apertures import (
    APERTURE_KEYS,
    aperture_rows,
    clear_aperture,
    set_automatic_semi_diameters,
)
from dolens.prescriptions.coatings import (
    COATING_KEY,
    check_coating,
    coating_from,
    coating_row,
    coatings_for,
)
from dolens.prescriptions.diffractive import (
    DIFFRACTIVE_KEY,
    diffractive_from,
    diffractive_row,
)
from dolens.prescriptions.numbers import (
    as_integer,
    as_number,
    as_numbers,
    check_range,
    curvature_from,
    curvature_row,
    radius_key,
    require_mapping,
)
from dolens.prescriptions.row_data import (
    BREAK_KIND,
    EXPANSION_KEY,
    PHASE_KEY,
    break_from,
    break_row,
    catalogue_expansion,
    element_rows,
    elements_from,
    environment_of,
    expansion_of,
    is_break,
    is_paraxial_lens,
    medium_of,
    phase_from,
    phase_row,
    power_row,
    sensor_from,
    sensor_row,
    with_power,
)
from dolens.prescriptions.states import STATES_KEY, state_rows, with_states
from dolens.prescriptions.system_data import (
    PUBLISHED_KEY,
    SYSTEM_DATA_KEYS,
    published_from,
    published_rows,
    set_object_fields,
    set_stop_semi_diameter,
    stop_row,
    system_data,
    system_data_of,
)

# Far more than a lens has; so many are built in seconds.
_MOST_SURFACES = 10_000
_LENS_KEYS = (
    "name",
    "source",
    PUBLISHED_KEY,
    "index_model",
    "stop",
    "object_material",
    COATING_KEY,
    "surfaces",
    "elements",
    "sensor",
    STATES_KEY,
    *SYSTEM_DATA_KEYS,
)
_SURFACE_KEYS = (
    *("type", "radius", *APERTURE_KEYS, PHASE_KEY, COATING_KEY, "thickness"),
    DIFFRACTIVE_KEY,
    *("material", EXPANSION_KEY, "note"),
)


def lens_from_prescription(
    prescription: Mapping[str, Any],
    dtype: torch.dtype = torch.float64,
    index_model: str | None = None,
    where: str = "lens",
    backend: str = "auto",
) -> Lens:
    """Build a lens from plain data.

    Args:
        prescription: as the module's docstring shows.
        dtype: precision of the lens.
        index_model: used instead of the prescription's own.

    Rarely needed:
        where: name of the prescription in messages, usually its file.
        backend: auto, reference, cpu or cuda.

    Raises:
        InputError: one line that names `where`, the surface and the key.
    """
    require_mapping(prescription, where)
    check_keys(prescription, _LENS_KEYS, where)
    check_range(prescription, dtype, where)
    name = str(prescription.get("name", where))
    try:
        model = find_index_model(
            str(prescription.get("index_model", "dfc")) if index_model is None else index_model
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    rows = _rows(prescription, where)
    sensor: dict[str, Any] = dict(sensor_from(prescription, where))
    data = system_data(prescription, where)
    air = environment_of(prescription, where)
    surfaces: list[Surface] = []
    thicknesses: list[float] = []
    expansions: list[float | None] = []
    first = prescription.get("object_material", "air")
    materials = [medium_of(first, model, f"{where}: object", air)]
    for number, row in enumerate(rows, 1):
        place = f"{where}: surface {number}"
        if is_break(row):
            surfaces.append(break_from(row, place, dtype))
            materials.append(media_of(materials).materials[-1])
        else:
            surfaces.append(_surface(stop_row(row, number, prescription), place, dtype))
            materials.append(medium_of(row.get("material"), model, place, air))
            given = row.get(COATING_KEY)
            if given is not None:
                surfaces[-1].coating = coating_from(given, place, model, air, dtype)
                check_coating(surfaces[-1].coating, materials[-1], place)
            given = row.get(DIFFRACTIVE_KEY)
            if given is not None:
                surfaces[-1].diffractive = diffractive_from(
                    given, surfaces[-1], (materials[-2], materials[-1]), place, model, air, dtype
                )
        expansions.append(expansion_of(row, materials[-1], place))
        if number < len(rows):
            if row.get("thickness") is None:
                raise InputError(f"{place}: 'thickness' is missing (mm to surface {number + 1})")
            thicknesses.append(as_number(row["thickness"], f"{place}: 'thickness'"))
        elif row.get("thickness") is not None:
            raise InputError(
                f"{place}: the last surface has no 'thickness'; its gap is 'sensor.distance'"
            )
    if prescription.get(COATING_KEY) is not None:
        uncoated = [n for n, row in enumerate(rows, 1) if row.get(COATING_KEY) is None]
        common = prescription[COATING_KEY]
        found = coatings_for(surfaces, materials, uncoated, common, where, model, air, dtype)
        for number, own in found:
            surfaces[number - 1].coating = own
    try:
        lens = Lens(
            surfaces,
            thicknesses,
            materials=materials,
            stop=as_integer(prescription.get("stop", 1), f"{where}: 'stop'"),
            index_model=model.name,
            name=name,
            dtype=dtype,
            elements=elements_from(prescription.get("elements"), dtype, where),
            thermal_expansions=expansions,
            backend=backend,
            source=str(prescription.get("source") or ""),
            published=published_from(prescription.get(PUBLISHED_KEY), where),
            **sensor,
            **data,
        )
        lens = set_object_fields(set_stop_semi_diameter(lens, prescription))
        lens = set_automatic_semi_diameters(lens, prescription)
        if not prescription.get(STATES_KEY):
            return lens

        def build(other: Mapping[str, Any], place: str) -> Lens:
            named = {"name": name, **other}
            return lens_from_prescription(named, dtype, index_model, place, backend)

        return with_states(lens, prescription, build, where)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(where) else f"{where}: {message}") from None


def prescription_of(lens: Lens) -> dict[str, Any]:
    """Return the prescription of a lens in its present state: plain numbers and strings, ready for
    YAML.

    Reading it back gives a lens with the same parameters to the last bit.
    """
    return {**_rows_of(lens), **state_rows(lens, _rows_of)}


def _rows_of(lens: Lens) -> dict[str, Any]:
    """Return the prescription of a lens without its states."""
    rows: dict[str, dict[str, Any]] = {}
    for (number, surface), material in zip(lens.surfaces.items(), lens.materials[1:], strict=True):
        if isinstance(surface, CoordinateBreak):
            rows[number] = break_row(surface) | _gap(lens, number)
            continue
        row: dict[str, Any] = {"type": surface.kind}
        for key, value in (*surface._parameters.items(), *surface._buffers.items()):
            if value is None:
                continue
            number_value: Any = value.detach().tolist()
            if key == "power" and surface.law is not None:
                row |= power_row(number_value)
                continue
            if key in surface.curvatures:
                row |= curvature_row(key, number_value)
            else:
                row[key] = number_value
        if surface.phase is not None:
            row[PHASE_KEY] = phase_row(surface.phase)
        if surface.coating is not None:
            row[COATING_KEY] = coating_row(surface.coating)
        if surface.diffractive is not None:
            row[DIFFRACTIVE_KEY] = diffractive_row(surface.diffractive)
        row |= aperture_rows(surface.aperture)
        row |= _gap(lens, number)
        row["material"] = material.name
        expansion = lens.thermal_expansions[int(number) - 1]
        if expansion is not None and catalogue_expansion(material) is None:
            row[EXPANSION_KEY] = expansion
        rows[number] = row
    return {
        "name": lens.name,
        **({"source": lens.source} if lens.source else {}),
        **published_rows(lens.published),
        "index_model": lens.index_model,
        "stop": lens.stop,
        "object_material": lens.materials[0].name,
        **system_data_of(lens),
        "surfaces": rows,
        **({"elements": element_rows(dict(lens.elements.items()))} if len(lens.elements) else {}),
        "sensor": sensor_row(lens),
    }


def _gap(lens: Lens, number: str) -> dict[str, float]:
    """Return the thickness behind a surface, which the last has not."""
    if number not in lens.thicknesses:
        return {}
    return {"thickness": float(lens.thicknesses[number].detach())}


def _surface(row: Mapping[str, Any], place: str, dtype: torch.dtype) -> Surface:
    kind = str(row.get("type", "sphere"))
    if kind not in SURFACES:
        raise InputError(
            f"{place}: type '{kind}' is unknown{did_you_mean(kind, SURFACES)} "
            f"(allowed: {', '.join((*SURFACES, BREAK_KIND))})"
        )
    shape = SURFACES[kind]
    try:
        if is_paraxial_lens(row):
            row = with_power(row)
        names = shape.parameter_names(row)
        radii = [radius_key(name) for name in names if name in shape.curvatures]
        check_keys(row, (*_SURFACE_KEYS, *names, *radii), place)
        values = {
            key: (as_numbers if key in shape.arrays else as_number)(row.get(key, 0.0), f"'{key}'")
            for key in names
            if key in row or key not in shape.optional
        }
        values |= {name: curvature_from(row, name) for name in names if name in shape.curvatures}
        if "curvature" not in names and not math.isinf(
            as_number(row.get("radius", math.inf), "'radius'", finite=False)
        ):
            raise InputError(f"a surface of type '{kind}' has no 'radius'")
        surface = shape(clear_aperture(row, place), values, dtype)
        if row.get(PHASE_KEY) is not None:
            if shape.law is not None:
                raise InputError(f"a surface of type '{kind}' cannot have a 'phase'")
            surface.phase = phase_from(row[PHASE_KEY], place, dtype)
        return surface
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(place) else f"{place}: {message}") from None


def _rows(prescription: Mapping[str, Any], where: str) -> list[Mapping[str, Any]]:
    surfaces = prescription.get("surfaces")
    if not isinstance(surfaces, Mapping) or not surfaces:
        raise InputError(f"{where}: 'surfaces' must map surface numbers from 1 to surfaces")
    if len(surfaces) > _MOST_SURFACES:
        raise InputError(
            f"{where}: has {len(surfaces)} surfaces; a lens has {_MOST_SURFACES} at most"
        )
    rows = {str(number): row for number, row in surfaces.items()}
    for number in range(1, len(rows) + 1):
        if str(number) not in rows:
            raise InputError(
                f"{where}: surface {number} is missing; surfaces are numbered 1 to {len(rows)} "
                f"without gaps, not {', '.join(rows)}"
            )
        require_mapping(rows[str(number)], f"{where}: surface {number}")
    return [rows[str(number)] for number in range(1, len(rows) + 1)]
