"""Names of the parameters that a state of a lens has for itself: `states.wide.thicknesses.5`."""

from collections.abc import Mapping
from typing import Any, TypeVar

Value = TypeVar("Value")

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


def values_in_state(lens: Any, state: str | None, values: Mapping[str, Value]) -> dict[str, Value]:
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
