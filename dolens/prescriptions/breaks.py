"""Coordinate breaks are read from rows of a prescription and written to them.

A break is a row of `surfaces` with a number and a thickness of its own; angles are in degrees,
lengths in mm, and what is not written is zero::

    '3': {type: coordinate_break, tilt_x: 45, decenter_y: 2, thickness: -50}

`order: tilt_first` turns the axes before it decentres them, and so undoes a break of the opposite
numbers (see `dolens.optics.surfaces.coordinate_break`).
"""

from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.elements import TILTS
from dolens.optics.parameter_names import file_value, to_lens_units
from dolens.optics.surfaces import BREAKS, CoordinateBreak
from dolens.optics.surfaces.coordinate_break import BREAK
from dolens.prescriptions.checks import as_number

KIND = CoordinateBreak.kind
# A tilt that no number of degrees gives to the last bit is written in radians, under this name.
_RADIANS = tuple(f"{name}_radians" for name in TILTS)
_KEYS = ("type", "thickness", "note", "order", *BREAK, *_RADIANS)
_OF_SURFACES = ("material", "radius", "curvature", "semi_diameter", "aperture", "obscuration")


def is_break(row: Mapping[str, Any]) -> bool:
    """Return whether a row of a prescription is a coordinate break."""
    return row.get("type") == KIND


def break_from(row: Mapping[str, Any], place: str, dtype: torch.dtype) -> CoordinateBreak:
    """Read a coordinate break.

    Raises:
        InputError: one line that names `place` and the key.
    """
    for key in _OF_SURFACES:
        if row.get(key) is not None:
            raise InputError(f"{place}: a coordinate break has no '{key}': light does not meet it")
    check_keys(row, _KEYS, place)
    order = str(row.get("order", CoordinateBreak.order))
    check_choice(order, BREAKS, f"{place}: 'order'")
    numbers = {}
    for name in BREAK:
        numbers[name] = to_lens_units(name, as_number(row.get(name, 0.0), f"{place}: '{name}'"))
        radians = f"{name}_radians"
        if radians in row:
            if name in row:
                raise InputError(f"{place}: give '{name}' or '{radians}', not both")
            numbers[name] = as_number(row[radians], f"{place}: '{radians}'")
    return BREAKS[order](numbers, dtype)


def break_row(surface: CoordinateBreak) -> dict[str, Any]:
    """Return the row that `break_from` reads back to the same parameters, to the last bit."""
    row: dict[str, Any] = {"type": KIND}
    for name, value in surface.named_parameters():
        number = float(value.detach())
        if number == 0.0:
            continue
        written = file_value(name, number)
        row |= {f"{name}_radians": number} if written is None else {name: written}
    if surface.order != CoordinateBreak.order:
        row["order"] = surface.order
    return row
