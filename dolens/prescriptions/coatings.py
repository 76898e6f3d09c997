"""Coatings of a prescription, read and written.

A surface may have a coating, and `coating` beside `surfaces` is that of all surfaces between air
and glass that have none of their own; cemented surfaces are then bare::

    coating: none                           # ideal | none | quarter_wave | any of the following
    surfaces:
      '1': {..., coating: ideal}            # passes all light: as if nothing were said
      '2': {..., coating: none}             # bare glass: Fresnel's equations
      '3': {..., coating: quarter_wave}     # a quarter of 550 nm of MgF2
      '4': {..., coating: {quarter_wave: 587.6, material: 1.38}}
      '5': {..., coating: [{material: MGF2, thickness: 99.5}, {material: 2.05, thickness: 134}]}
      '6': {..., coating: {table: [[550, 0, 0.01, 0.01, 0.99, 0.99], ...]}}
      '7': {..., material: mirror, coating: {layers: [], substrate: [0.96, 6.69]}}

Layers are in the order in which light meets them in the lens, their thicknesses in nm.  A
`material` is a medium as elsewhere, a complex index [n, k], or rows [nm, n, k] of one.  Rows of a
table are nm, degrees in front of the surface (behind it with `angles: behind`), and the shares of
power R_s, R_p, T_s, T_p; they give every angle at every wavelength.  A mirror's coating needs the
`substrate` behind its layers.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import torch

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.coatings import (
    Coating,
    CoatingTable,
    Film,
    OpticalConstants,
    Table,
    quarter_wave,
)
from dolens.optics.glass import Environment
from dolens.optics.lens import Lens, check_crystals, check_metasurfaces
from dolens.optics.materials import (
    MIRROR,
    IndexModel,
    Medium,
    index_model,
    is_glass,
    media_of,
    parse_material,
)
from dolens.optics.metasurface import Metasurface
from dolens.optics.surfaces import Surface
from dolens.prescriptions.numbers import as_number, as_positive
from dolens.prescriptions.row_data import environment_of

COATING_KEY = "coating"
IDEAL, BARE, QUARTER_WAVE = "ideal", "none", "quarter_wave"
_NAMES = (IDEAL, BARE, QUARTER_WAVE)
# nm and name of the layer that `quarter_wave` alone means.
_USUAL_WAVELENGTH, _USUAL_FILM = 550.0, "MGF2"
_FORMS = {
    QUARTER_WAVE: (QUARTER_WAVE, "material"),
    "table": ("table", "angles"),
    "layers": ("layers", "substrate"),
}
_MOST_LAYERS, _COLUMNS = 1000, 6
# The side of a surface that the angles of a table are those of.
_FRONT, _BEHIND = "front", "behind"


def coating_from(
    value: Any,
    place: str,
    model: IndexModel,
    air: Environment | None,
    dtype: torch.dtype,
) -> Coating | None:
    """Return the coating that a prescription describes; None: ideal.

    Raises:
        InputError: one line that names the place, the key, and what is allowed.
    """
    where = f"{place}: coating"
    try:
        return _coating(value, model, air, dtype)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _coating(
    value: Any, model: IndexModel, air: Environment | None, dtype: torch.dtype
) -> Coating | None:
    if isinstance(value, list | tuple):
        value = {"layers": value}
    if not isinstance(value, Mapping):
        check_choice(str(value), _NAMES, "name")
        if value == QUARTER_WAVE:
            value = {QUARTER_WAVE: _USUAL_WAVELENGTH}
        else:
            return None if value == IDEAL else Coating(dtype=dtype)
    form = next((form for form in _FORMS if form in value), None)
    if form is None:
        raise InputError(f"has none of the keys {', '.join(_FORMS)}, and is none of {_NAMES}")
    check_keys(value, _FORMS[form], form)
    if form == "table":
        side = str(value.get("angles", _FRONT))
        check_choice(side, (_FRONT, _BEHIND), "'angles'")
        return CoatingTable(replace(_table(value["table"]), turned=side == _BEHIND))
    if form == QUARTER_WAVE:
        wavelength = as_positive(value[QUARTER_WAVE], f"'{QUARTER_WAVE}'")
        film = _film(value.get("material", _USUAL_FILM), model, air)
        return quarter_wave(film, wavelength, dtype)
    layers = value["layers"]
    if not isinstance(layers, list | tuple) or len(layers) > _MOST_LAYERS:
        raise InputError(f"'layers' must be a list of at most {_MOST_LAYERS} layers")
    films, thicknesses = [], []
    for number, layer in enumerate(layers, 1):
        place = f"layer {number}"
        if not isinstance(layer, Mapping):
            raise InputError(f"{place}: must have 'material' and 'thickness', not {layer!r}")
        check_keys(layer, ("material", "thickness"), place)
        for key in ("material", "thickness"):
            if layer.get(key) is None:
                raise InputError(f"{place}: '{key}' is missing")
        films.append(_film(layer["material"], model, air))
        thicknesses.append(as_number(layer["thickness"], f"{place}: 'thickness'"))
    substrate = value.get("substrate")
    behind = None if substrate is None else _film(substrate, model, air)
    return Coating(films, thicknesses, behind, dtype)


def check_coating(coating: Coating | None, material: Medium, place: str) -> None:
    """Raise `InputError` where a mirror's coating has no substrate, or another's has one."""
    if coating is None or isinstance(coating, CoatingTable):
        return
    if material is MIRROR and coating.substrate is None:
        raise InputError(
            f"{place}: coating: a mirror's needs the 'substrate' behind its layers, such as "
            "{layers: [], substrate: [0.96, 6.69]}"
        )
    if material is not MIRROR and coating.substrate is not None:
        raise InputError(f"{place}: coating: 'substrate' is a mirror's; here it is the 'material'")


def coatings_for(
    surfaces: Sequence[Surface],
    materials: Sequence[Medium],
    numbers: Iterable[int],
    value: Any,
    place: str,
    model: IndexModel,
    air: Environment | None,
    dtype: torch.dtype,
) -> Iterator[tuple[int, Coating | None]]:
    """Yield the numbers of those surfaces that a coating of the whole lens holds for, and theirs.

    It holds for refracting surfaces; those between two glasses are cemented, and bare.  A table of
    cells says itself what passes.

    Args:
        surfaces: of the lens.
        materials: before the first and behind each surface.
        numbers: of the surfaces that may get it.
        value: the coating as a prescription describes it.
        place: begins messages.
        model: index model of the lens.
        air: temperature and pressure.
        dtype: precision of the parameters.
    """
    media = media_of(materials).materials
    for number in numbers:
        surface, before, behind = surfaces[number - 1], media[number - 1], media[number]
        if surface.changes_axes or surface.law is not None or before == behind:
            continue
        if isinstance(surface.diffractive, Metasurface):
            continue
        found = coating_from(value, place, model, air, dtype)
        check_coating(found, behind, place)
        if found is not None and is_glass(before) and is_glass(behind):
            found = Coating(dtype=dtype)
        yield number, found


def coated(lens: Lens, coating: Any) -> Lens:
    """Return a copy of a lens with other coatings.

    Args:
        lens: it stays as it is.
        coating: as a prescription describes it (see the module), for all surfaces between air and
            glass; or surface number → coating, for these alone.

    Raises:
        InputError: one line that names the surface, the key, and what is allowed.
    """
    found, model = copy.deepcopy(lens), index_model(lens.index_model)
    where = f"lens '{lens.name}'"
    air = environment_of({"temperature": lens.temperature, "pressure": lens.pressure}, where)
    surfaces = list(found.surfaces.values())
    media = media_of(found.materials).materials
    if not isinstance(coating, Mapping) or any(form in coating for form in _FORMS):
        numbers = range(1, len(surfaces) + 1)
        for number, own in coatings_for(
            surfaces, found.materials, numbers, coating, where, model, air, lens.dtype
        ):
            surfaces[number - 1].coating = own
        _check_faces(surfaces, media, where)
        return found
    for key, value in coating.items():
        if str(key) not in found.surfaces:
            raise InputError(f"{where}: coating: there is no surface {key}")
        place, surface = f"{where}: surface {key}", found.surfaces[str(key)]
        if surface.changes_axes:
            raise InputError(f"{place} is a coordinate break; light does not meet it")
        surface.coating = coating_from(value, place, model, air, lens.dtype)
        check_coating(surface.coating, found.materials[int(key)], place)
    _check_faces(surfaces, media, where)
    return found


def _check_faces(surfaces: Sequence[Surface], media: Sequence[Medium], where: str) -> None:
    try:
        check_crystals(surfaces, media)
        check_metasurfaces(surfaces)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def coating_row(coating: Coating) -> Any:
    """Return what `coating_from` reads back as the same coating, to the last bit."""
    if isinstance(coating, CoatingTable):
        table = coating.table
        rows = [
            [nm, angle, *(rows[i][j] for rows in table.values)]
            for i, nm in enumerate(table.wavelengths)
            for j, angle in enumerate(table.angles)
        ]
        return {"table": rows} | ({"angles": _BEHIND} if table.turned else {})
    thicknesses = [float(value.detach()) for value in coating.parameters()]
    layers = [
        {"material": _material_of(film), "thickness": thickness}
        for film, thickness in zip(coating.films, thicknesses, strict=True)
    ]
    if coating.substrate is not None:
        return {"layers": layers, "substrate": _material_of(coating.substrate)}
    return layers or BARE


def _film(value: Any, model: IndexModel, air: Environment | None) -> Film:
    """Return the medium of a layer."""
    if not isinstance(value, list | tuple):
        found = parse_material(str(value), model, air)
        if found is MIRROR:
            raise InputError("'material': a mirror is no layer; give the metal's index, [n, k]")
        return found
    rows = value if value and isinstance(value[0], list | tuple) else [[0.0, *value]]
    numbers = [[as_number(entry, "'material'") for entry in row] for row in rows]
    if any(len(row) != 3 for row in numbers):
        raise InputError("'material': a complex index is [n, k], or rows [nm, n, k]")
    for nm, n, k in numbers:
        if not (n > 0.0 and k >= 0.0):
            raise InputError(f"'material': n must be positive and k not negative, not {n:g}, {k:g}")
        if len(rows) > 1 and not nm > 0.0:
            raise InputError(f"'material': a wavelength must be positive, not {nm:g} nm")
    columns = [tuple(column) for column in zip(*numbers, strict=True)]
    if any(a >= b for a, b in pairwise(columns[0])):
        raise InputError("'material': the wavelengths of rows [nm, n, k] must rise")
    return OpticalConstants(columns[0], columns[1], columns[2])


def _material_of(film: Film) -> Any:
    if not isinstance(film, OpticalConstants):
        return film.name
    rows = [list(row) for row in zip(film.wavelengths, film.n, film.k, strict=True)]
    return rows if len(rows) > 1 else rows[0][1:]


def _table(value: Any) -> Table:
    if not isinstance(value, list | tuple) or not value:
        raise InputError("'table' must be rows [nm, degrees, R_s, R_p, T_s, T_p]")
    rows = {}
    for row in value:
        if not isinstance(row, list | tuple) or len(row) != _COLUMNS:
            raise InputError(f"'table': a row is [nm, degrees, R_s, R_p, T_s, T_p], not {row!r}")
        nm, angle, *shares = (as_number(entry, "'table'") for entry in row)
        if not nm > 0.0 or not 0.0 <= angle < 90.0:
            raise InputError(f"'table': {nm:g} nm at {angle:g}°: allowed: positive, and 0 to 90")
        r_s, r_p, t_s, t_p = shares
        if min(shares) < 0.0 or max(r_s + t_s, r_p + t_p) > 1.0 + 1e-6:
            raise InputError(
                f"'table': {nm:g} nm at {angle:g}°: shares are 0 or more, and R + T at most 1"
            )
        if (nm, angle) in rows:
            raise InputError(f"'table': {nm:g} nm at {angle:g}° is given twice")
        rows[nm, angle] = shares
    wavelengths, angles = (sorted({key[i] for key in rows}) for i in (0, 1))
    for nm in wavelengths:
        for angle in angles:
            if (nm, angle) not in rows:
                raise InputError(f"'table': {nm:g} nm at {angle:g}° is missing")
    values = tuple(
        tuple(tuple(rows[nm, angle][at] for angle in angles) for nm in wavelengths)
        for at in range(_COLUMNS - 2)
    )
    return Table(tuple(wavelengths), tuple(angles), values)
