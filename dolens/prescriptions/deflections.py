"""Phases and ideal lenses in prescriptions.

A surface of any shape may have a phase::

    '3': {type: sphere, radius: -80, ..., phase: {type: grating, grooves: 600, order: -1}}
    '4': {type: plane, ..., phase: {type: radial, norm_radius: 10, p2: -1133.35, p4: 341.9}}
    '5': {type: plane, ..., phase: {type: xy, norm_radius: 10, x: 12.5, x2y: 3.0}}
    '6': {type: plane, ..., phase: {type: zernike_fringe, norm_radius: 10, z4: 0.5, z9: -0.1}}

`grooves` are per mm, parallel to x.  Coefficients are radians of the first order, of
(r/norm_radius)² and so on; those of Zernike polynomials are waves.  `order` is 1 and `norm_radius`
1 mm unless they are given.  `efficiency`, from 0 to 1, is data.

An ideal lens is `{type: paraxial_lens, focal_length: 100}` (mm) or has its `power` (1/mm).
"""

import math
from collections.abc import Mapping
from typing import Any

import torch

from dolens.errors import InputError, check_keys, did_you_mean
from dolens.optics.surfaces import PHASES, ParaxialLens, Phase
from dolens.prescriptions.checks import as_integer, as_number, as_positive, require_mapping

PHASE_KEY = "phase"
_KEYS = ("type", "order", "efficiency")
_DEFAULTS = {"order": 1.0, "norm_radius": 1.0}


def phase_from(value: object, place: str, dtype: torch.dtype) -> Phase:
    """Build the phase of a surface from a prescription.

    Raises:
        InputError: one line that names the place, the key, and what is allowed.
    """
    where = f"{place}: phase"
    require_mapping(value, where)
    row: Mapping[str, Any] = value  # type: ignore[assignment]
    kind = str(row.get("type"))
    if kind not in PHASES:
        raise InputError(
            f"{where}: type '{kind}' is unknown{did_you_mean(kind, PHASES)} "
            f"(allowed: {', '.join(PHASES)})"
        )
    try:
        names = PHASES[kind].parameter_names(row)
        check_keys(row, (*_KEYS, *names), where)
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


def power_of(focal_length: object) -> float:
    """Return one over a focal length (mm), which may be infinite.

    Raises:
        InputError: it is no number, or zero.
    """
    length = as_number(focal_length, "'focal_length'", finite=False)
    if length == 0.0:
        raise InputError("'focal_length' is 0; write .inf for a lens without power")
    return 1.0 / length


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
