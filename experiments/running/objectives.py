"""The metrics that a run returns: one, or several for a search with several objectives."""

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import ListConfig

from dolens.errors import InputError


def objective_names(objective: Any) -> tuple[str, ...]:
    """Return the names of the objectives.

    Args:
        objective: the setting: a name, or a list of names.

    Raises:
        InputError: something else, an empty list, or a name twice.
    """
    names = tuple(objective) if isinstance(objective, list | tuple | ListConfig) else (objective,)
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"objective: {objective!r}; allowed: the name of a metric, or a list of them"
        )
    if len(set(names)) < len(names):
        raise InputError(f"objective: {', '.join(names)}: a name stands twice")
    return names


def returned(names: Sequence[str], numbers: Mapping[str, float]) -> float | tuple[float, ...]:
    """Return the objectives of a finished run: a number, or as many as there are names.

    Raises:
        InputError: the run has no such metric.
    """
    for name in names:
        if name not in numbers:
            raise InputError(f"objective: '{name}' is not among the metrics ({', '.join(numbers)})")
    values = tuple(numbers[name] for name in names)
    return values if len(values) > 1 else values[0]
