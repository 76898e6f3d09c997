"""Parameters of a lens by name: their units in files, and those that belong to a state.

A lens holds lengths in mm and angles in radians.  Files, configuration and tables hold angles in
degrees.  A parameter that a state has for itself is named `states.wide.thicknesses.5`.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from dolens.optics.elements import DISPLACEMENTS, TILTS
from dolens.optics.fabrication_errors import ASTIGMATISMS

Value = TypeVar("Value", float, Tensor)


class Unit(NamedTuple):
    """A unit that files give a parameter in.

    Attributes:
        name: as tables and figures print it; nothing where it depends on the surface.
        factor: the lens's own unit in one of it: radians in a degree, or 1.
    """

    name: str
    factor: float = 1.0


DEGREE = Unit("deg", math.pi / 180.0)
MILLIMETRE = Unit("mm")
NANOMETRE = Unit("nm")
PER_MILLIMETRE = Unit("1/mm")
RADIAN = Unit("rad")
WAVE = Unit("waves")
UNNAMED = Unit("")
_UNIT_OF = {
    **dict.fromkeys(TILTS, DEGREE),
    **dict.fromkeys(DISPLACEMENTS, MILLIMETRE),
    "sensor_distance": MILLIMETRE,
    "power": PER_MILLIMETRE,
    "grooves": PER_MILLIMETRE,
    **dict.fromkeys(
        ("curvature", "curvature_x", "curvature_y", "sensor_curvature"), PER_MILLIMETRE
    ),
    "normalization_radius": MILLIMETRE,
    **dict.fromkeys(ASTIGMATISMS, MILLIMETRE),
}
# Of names whose last part is a number or a coordinate.
_UNIT_OF_GROUP = {"thicknesses": MILLIMETRE, "sources": MILLIMETRE}


def unit_of(name: str) -> Unit:
    """Return the unit of a parameter in files and configuration.

    Args:
        name: as `surfaces.1.curvature`, `elements.front.tilt_x`, `sources.1.z` or
            `states.wide.thicknesses.5`.
    """
    _, name = split_state(name)
    first, _, _ = name.partition(".")
    group, _, last = name.rpartition(".")
    others = UNNAMED
    if group.endswith((".coating", ".diffractive")):
        return NANOMETRE
    if group.endswith(".phase"):
        # Zernike's coefficients are waves, all others radians.
        others = WAVE if last[:1] == "z" else RADIAN
    return _UNIT_OF_GROUP.get(first) or _UNIT_OF.get(last, others)


def to_lens_units(name: str, value: Value) -> Value:
    """Convert a parameter's value from files (degrees, mm) to the lens's own unit (radians, mm)."""
    return value * unit_of(name).factor


def to_file_units(name: str, value: Value) -> Value:
    """Convert a parameter's value from the lens's own unit (radians, mm) to that of files."""
    return value / unit_of(name).factor


def unit_factors(names: Iterable[str], device: torch.device | str = "cpu") -> Tensor:
    """Return the factors (P,), float64, from the units of files to the lens's own."""
    factors = [unit_of(name).factor for name in names]
    return torch.tensor(factors, dtype=torch.float64, device=device)


def file_value(name: str, value: float) -> float | None:
    """Return the value in files' units that `to_lens_units` turns into this one to the last bit.

    Returns:
        None where rounding skips the value, so that no number of degrees stands for it.
    """
    guess = value * (1.0 / unit_of(name).factor)
    for candidate in (guess, math.nextafter(guess, -math.inf), math.nextafter(guess, math.inf)):
        if to_lens_units(name, candidate) == value:
            return candidate
    return None


StateValue = TypeVar("StateValue")

# They begin with this.
STATES = "states"


def split_state(name: str) -> tuple[str | None, str]:
    """Return the state that a parameter belongs to, or None, and its name there."""
    if not name.startswith(f"{STATES}."):
        return None, name
    _, state, base = name.split(".", 2)
    return state, base


def names_of_state(lens: Any, state: str) -> set[str]:
    """Return the names in the lens of the parameters that a state has for itself."""
    return {f"{STATES}.{state}.{base}" for base, _ in lens.states[state].named_parameters()}


def values_in_state(
    lens: Any, state: str | None, values: Mapping[str, StateValue]
) -> dict[str, StateValue]:
    """Return those of some values that the lens in a state has, by their names there.

    Args:
        lens: the lens with its states.
        state: None for the lens itself.
        values: name of a parameter in the lens → value.
    """
    own = set() if state is None else names_of_state(lens, state)
    hidden = {split_state(name)[1] for name in own}
    found = {}
    for name, value in values.items():
        if name in own:
            found[split_state(name)[1]] = value
        elif not name.startswith(f"{STATES}.") and name not in hidden:
            found[name] = value
    return found
