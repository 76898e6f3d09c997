"""Elements and their poses are read from a prescription and written to it.

``elements`` maps names to groups of neighbouring surfaces; angles are in degrees, lengths in mm::

    elements:
      '1': {surfaces: [1, 2], tilt_x: 0.5, decenter_y: 0.02, pivot: [0, 0, 0]}

The pivot counts from the vertex of the element's first surface, and what is not written is zero.
"""

from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.optics.elements import DISPLACEMENTS, TILTS, Element
from dolens.optics.parameter_names import file_value, to_lens_units
from dolens.prescriptions.checks import as_integer, as_number, require_mapping

# A tilt that no number of degrees gives to the last bit is written in radians, under this name.
_RADIANS = tuple(f"{name}_radians" for name in TILTS)


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
        row: dict[str, Any] = {"surfaces": [element.first, element.last]}
        for key, value in element.named_parameters():
            number = float(value.detach())
            if number == 0.0:
                continue
            written = file_value(key, number)
            row |= {f"{key}_radians": number} if written is None else {key: written}
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
    pose = {}
    for name in TILTS:
        if f"{name}_radians" in row and name in row:
            raise InputError(f"{place}: give '{name}' or '{name}_radians', not both")
        pose[name] = to_lens_units(name, as_number(row.get(name, 0.0), f"{place}: '{name}'"))
        if f"{name}_radians" in row:
            pose[name] = as_number(row[f"{name}_radians"], f"{place}: '{name}_radians'")
    for name in DISPLACEMENTS:
        pose[name] = as_number(row.get(name, 0.0), f"{place}: '{name}'")
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
