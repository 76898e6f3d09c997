"""States of one lens: zoom, focus, temperature (other programs say configurations).

A state has parameters of its own in place of some of the lens's, and data of its own: fields,
object distance, wavelengths, clear apertures, temperature.  All else is shared.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor, nn

from dolens.errors import InputError, did_you_mean
from dolens.optics.glass import STANDARD_TEMPERATURE
from dolens.optics.parameter_names import values_in_state
from dolens.optics.paraxial_rays import reversals
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.thermal_lens import expanded_values, lens_at

# Attributes of a lens that a state may have otherwise.
STATE_DATA = (
    "fields",
    "object_distance",
    "wavelengths",
    "reference_wavelength",
    "wavelength_weights",
    "published",
    "stop_note",
)


@dataclass
class StateData:
    """Holds what a state has otherwise than its lens, besides parameters.

    Attributes:
        given: name of an attribute of the lens (`STATE_DATA`) → its value in this state.
        apertures: number of a surface → its clear aperture in this state.
        temperature: °C, that the lens is heated or cooled to; None where the state does not say.
        pressure: atm; likewise.
    """

    given: dict[str, Any] = field(default_factory=dict)
    apertures: dict[str, ClearAperture] = field(default_factory=dict)
    temperature: float | None = None
    pressure: float | None = None


class _Branch(nn.Module):
    """Holds parameters and further branches under the parts of their names."""


class LensState(_Branch):
    """Holds the parameters that one state has for itself, by the names that the lens's have, and
    its data.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], data: StateData) -> None:
        super().__init__()
        for name, parameter in parameters.items():
            *path, last = name.split(".")
            branch: nn.Module = self
            for part in path:
                # Straight into the tables: the names of surfaces and gaps are numbers.
                inner = branch._modules.get(part)
                if inner is None:
                    inner = branch._modules[part] = _Branch()
                branch = inner
            branch._parameters[last] = parameter
        self.data = data


class LensStates(nn.Module):
    """Holds the states of a lens in their order; a lens without states has an empty one."""

    def __init__(self, states: Mapping[str, LensState] | None = None) -> None:
        super().__init__()
        # Straight into the table: a state may be called `half`, as a method of a module is.
        self._modules.update(states or {})

    def __len__(self) -> int:
        """Return the number of states."""
        return len(self._modules)

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the states."""
        return iter(self._modules)

    def __getitem__(self, name: str) -> LensState:
        """Return a state by its name."""
        state = self._modules[name]
        assert isinstance(state, LensState)  # nothing else is put there
        return state


class InStates:
    """Methods of `Lens` about its states."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Return the names of the states in their order; none of a lens without states."""
        states: LensStates = getattr(self, "states")  # noqa: B009 - of the lens
        return tuple(states)

    def in_state(self, name: str | None) -> Self:
        """Return this lens in one of its states.

        It shares all parameters with this lens but those that the state has for itself, which are
        the state's own: gradients of what is computed from it flow to both.  Lengths and curvatures
        changed later, in this lens or in that one, are changed in both.  In a state with a
        temperature or a pressure the lens is a heated copy (`Lens.at`): its parameters follow those
        of this lens no longer, and have no gradient; `values_there` gives them with their graph.

        Args:
            name: of the state; None returns this lens itself, without given values of states.

        Raises:
            InputError: there is no such state; the message lists those that there are.
        """
        return in_state(self, name)


def check_state(lens: Any, name: str) -> None:
    """Raise `InputError` where a lens has no state of a name."""
    if name not in lens.state_names:
        near = did_you_mean(name, lens.state_names)
        raise InputError(
            f"lens '{lens.name}' has no state '{name}'{near} "
            f"(allowed: {', '.join(lens.state_names) or 'none, as the lens has no states'})"
        )


def in_state(lens: Any, name: str | None) -> Any:
    """Return a lens in a state; see `Lens.in_state`."""
    if lens.given:
        there = values_there(lens.as_stored(), name, lens.given)
        return in_state(lens.as_stored(), name).with_values(there)
    if name is None:
        return lens
    found, data = overlaid(lens, name), lens.states[name].data
    if data.temperature is None and data.pressure is None:
        return found
    heated = lens_at(found, _temperature(lens, data), data.pressure)
    return heated.requires_grad_(False)


def overlaid(lens: Any, name: str) -> Any:
    """Return a lens in a state at the lens's own temperature and pressure.

    Raises:
        InputError: there is no such state.
    """
    check_state(lens, name)
    lens = lens.as_stored()
    state = lens.states[name]
    own = dict(state.named_parameters())
    # What deepcopy finds here it takes as it is.
    memo: dict[int, Any] = {id(tensor): tensor for tensor in (*lens.parameters(), *lens.buffers())}
    memo |= {id(medium): medium for medium in lens._materials}
    memo |= {id(parameter): own[base] for base, parameter in lens.named_parameters() if base in own}
    memo[id(lens.states)] = LensStates()
    found = copy.deepcopy(lens, memo)
    found.name = f"{lens.name}, {name}" if lens.name else name
    found.state_name = name
    data = state.data
    for key, value in data.given.items():
        setattr(found, key, value)
    for number, aperture in data.apertures.items():
        found.surfaces[number].aperture = aperture
    if any(surface.changes_axes for surface in found.surfaces.values()):
        found.reversals = ()
        found.reversals = reversals(found.system(), found.primary_wavelength)
    return found


def _temperature(lens: Any, data: StateData) -> float:
    if data.temperature is not None:
        return data.temperature
    return STANDARD_TEMPERATURE if lens.temperature is None else lens.temperature


@torch.no_grad()
def at_temperature(lens: Any, temperature: float, pressure: float | None = None) -> Any:
    """Return a copy of a lens at another temperature and pressure, in all its states; see
    `lens_at`.
    """
    lens = lens.storing_its_values() if lens.given else lens
    found = lens_at(lens, temperature, pressure)
    for name in lens.state_names:
        hot, state = lens_at(overlaid(lens, name), temperature, pressure), found.states[name]
        for base, parameter in state.named_parameters():
            parameter.copy_(hot.get_parameter(base))
        for number in state.data.apertures:
            state.data.apertures[number] = hot.surfaces[number].aperture
    return found


def state_temperature(lens: Any, name: str | None) -> float | None:
    """Return the temperature (°C) that a state heats a lens to; None where it does not."""
    data = StateData() if name is None else lens.states[name].data
    if data.temperature is None and data.pressure is None:
        return None
    return _temperature(lens, data)


def values_there(lens: Any, name: str | None, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return parameters of a lens in a state that follow from values of the lens's own.

    In a state with a temperature these are all that expand: differentiable functions of the values.

    Args:
        lens: the lens with its states.
        name: of the state; None for the lens itself.
        values: name of a parameter in the lens → value.
    """
    there = values_in_state(lens, name, values)
    temperature = state_temperature(lens, name)
    if name is None or temperature is None:
        return there
    cold = overlaid(lens, name)
    stored = {base: parameter.detach() for base, parameter in cold.named_parameters()}
    return there | expanded_values(cold, temperature, stored | there)


@torch.no_grad()
def state_of_difference(lens: Any, other: Any, own: Iterable[str], data: StateData) -> LensState:
    """Return the state that makes another lens of a lens.

    Args:
        lens: without states.
        other: of the same structure, as it is in the state.
        own: names of the parameters that the state has for itself.
        data: apertures and attributes are added to it where the lenses differ.
    """
    for key in STATE_DATA:
        if getattr(lens, key) != getattr(other, key):
            data.given[key] = getattr(other, key)
    for number, surface in lens.surfaces.items():
        aperture = other.surfaces[number].aperture
        if aperture != surface.aperture:
            data.apertures[number] = aperture
    values = dict(other.named_parameters())
    return LensState({name: nn.Parameter(values[name].detach().clone()) for name in own}, data)
