"""Diffractive elements of a prescription, read and written.

A surface may be a diffractive element.  Its relief makes the surface's `phase`, or it is given by
its heights (nm), or on a plane it is both in sum::

    '1': {type: plane, ..., phase: {type: radial, norm_radius: 2, p2: -5700},
          diffractive: {design_wavelength: 550, levels: 16}}
    '2': {type: plane, ..., diffractive: {pixels: [[0, 350], [700, 0]], pitch: 0.002, fill: 0.95}}
    '3': {type: plane, ..., diffractive: {rings: [0, 550, 0, 550], pitch: 0.01, material: 1.5}}

A plane may have cells of a metasurface instead, whose table is a file or rows (see cells.py)::

    '4': {type: plane, ..., diffractive: {cells: pillars.csv, pitch: 0.0004, widths: [[90, 120]]}}

The rows of `pixels` run along y and its columns along x, both rising, about the vertex; `rings` go
from the vertex outwards.  `pitch` (mm) is theirs.  Heights are taken modulo `depth` (nm), which of
a design wavelength follows from it.  `material` is that of the relief, in air or in the rarer of
the two media; without it it is the denser one.  `levels`, `etch_scale` and `etch_errors` (nm, of
masks, the shallowest first) say how it is made (see `dolens.optics.diffractive`).
"""

from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.optics.diffractive import VISIBLE, DiffractiveElement, Relief
from dolens.optics.glass import Environment
from dolens.optics.materials import MIRROR, IndexModel, Medium, parse_material
from dolens.optics.metasurface import Metasurface
from dolens.optics.surfaces.base import Surface, tensor_of
from dolens.prescriptions.cells import TABLE_KEY, metasurface_from, metasurface_row
from dolens.prescriptions.numbers import as_integer, as_number, as_numbers, require_mapping

DIFFRACTIVE_KEY = "diffractive"
_ARRAYS = {"pixels": 2, "rings": 1}
_NUMBERS = ("design_wavelength", "depth", "pitch", "fill", "etch_scale")
_KEYS = (*_ARRAYS, *_NUMBERS, "material", "levels", "etch_errors", TABLE_KEY)


def diffractive_from(
    value: object,
    surface: Surface,
    media: tuple[Medium, Medium],
    place: str,
    model: IndexModel,
    air: Environment | None,
    dtype: torch.dtype,
) -> DiffractiveElement | Metasurface:
    """Build the diffractive element of a surface from a prescription.

    Raises:
        InputError: one line that names the place, the key, and what is allowed.
    """
    where = f"{place}: {DIFFRACTIVE_KEY}"
    require_mapping(value, where)
    row: Mapping[str, Any] = value  # type: ignore[assignment]
    try:
        if MIRROR in media:
            raise InputError("a mirror cannot have one")
        if TABLE_KEY in row:
            return metasurface_from(row, surface, where, dtype)
        check_keys(row, _KEYS, where)
        arrays = set(_ARRAYS) & set(row)
        if arrays and surface.phase is not None and not surface.flat:
            raise InputError(
                f"a surface of type '{surface.kind}' has '{arrays.pop()}' or a 'phase', not both "
                "(plane: both)"
            )
        given = {key: as_number(row[key], f"'{key}'") for key in _NUMBERS if key in row}
        if len([key for key in _ARRAYS if key in row]) > 1:
            raise InputError("give 'pixels' or 'rings', not both")
        heights = None
        for key, dimensions in _ARRAYS.items():
            if key in row:
                heights = tensor_of(as_numbers(row[key], f"'{key}'"), key, dtype)
                if heights.ndim != dimensions:
                    raise InputError("'pixels' must be rows of numbers, and 'rings' a list, nm")
        if heights is None and surface.phase is None:
            raise InputError("needs 'pixels' or 'rings', or a 'phase' of the surface")
        if surface.phase is not None and "design_wavelength" not in row:
            raise InputError("'design_wavelength' is missing (nm), which makes heights of a phase")
        if surface.phase is not None and not bool(surface.phase.order):
            raise InputError("the phase's 'order' is 0, and no relief makes it")
        material = None
        if "material" in row:
            material = parse_material(str(row["material"]), model, air)
            if material is MIRROR:
                raise InputError("'material': a mirror is no relief; give a medium")
        relief = Relief(
            material=material,
            heights=heights,
            levels=None if row.get("levels") is None else as_integer(row["levels"], "'levels'"),
            etch_errors=tuple(
                as_number(e, "'etch_errors'") for e in _list(row.get("etch_errors", []))
            ),
            **given,
        )
        element = DiffractiveElement(relief, dtype)
        relief.step(*media, relief.design_wavelength or VISIBLE)
        return element
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(where) else f"{where}: {message}") from None


def _list(value: object) -> list[object]:
    if not isinstance(value, list | tuple):
        raise InputError("'etch_errors' must be a list of numbers, nm")
    return list(value)


def diffractive_row(element: DiffractiveElement | Metasurface) -> dict[str, Any]:
    """Return what `diffractive_from` reads back as the same element, to the last bit."""
    if isinstance(element, Metasurface):
        return metasurface_row(element)
    data, plain = element.data, Relief()
    row: dict[str, Any] = {
        key: getattr(data, key)
        for key in (*_NUMBERS, "levels")
        if getattr(data, key) != getattr(plain, key)
    }
    if data.material is not None:
        row["material"] = data.material.name
    if data.etch_errors:
        row["etch_errors"] = list(data.etch_errors)
    if element.heights is not None:
        row["pixels" if element.heights.ndim == 2 else "rings"] = element.heights.detach().tolist()
    return row
