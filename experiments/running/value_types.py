"""Values that no class can take are refused by the name that a user gave them."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from dolens.errors import InputError
from dolens.experiments.running.schedules import check_schedule
from dolens.experiments.running.target_keys import (
    REFERENCE,
    Target,
    located,
    targets,
    value_at,
)
from dolens.typed_values import check_type, hints_of


def refuse_wrong_types(plain: Mapping[str, Any], parts: Sequence[str]) -> None:
    """Refuse values beside a `_target_` that the hints of its arguments do not allow.

    Args:
        plain: the configuration, not resolved; what refers to another setting as a whole
            (`${seed}`) is looked up, and named by that; other interpolations are left alone.
        parts: top-level keys that Hydra makes something of.

    Raises:
        InputError: the first such value.
    """
    for target in targets(plain, parts):
        make = located(target)
        hints = hints_of(make)
        for key in target.keys:
            if key not in hints:
                continue
            path, value = _followed(plain, f"{target.path}.{key}", target.values[key])
            if not _is_open(value):
                check_type(value, hints[key], path)
        if isinstance(make, type) and issubclass(make, torch.optim.Optimizer):
            _try_optimizer(plain, target, make)
        if isinstance(make, type) and issubclass(make, torch.optim.lr_scheduler.LRScheduler):
            check_schedule(target.path, _known(plain, target))


def _try_optimizer(plain: Mapping[str, Any], target: Target, make: type) -> None:
    """Make an optimizer of torch or of dolens of a number: it checks its settings before work."""
    if not make.__module__.startswith(("torch.optim", "dolens.optimize")):
        return
    try:
        make([torch.nn.Parameter(torch.zeros(1))], **_known(plain, target))
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{target.path}: {error}") from None


def _known(plain: Mapping[str, Any], target: Target) -> dict[str, Any]:
    """Return the values of a target that are known before anything is made."""
    values = {key: _followed(plain, key, value)[1] for key, value in target.values.items()}
    return {key: value for key, value in values.items() if not _is_open(value)}


def _followed(plain: Mapping[str, Any], path: str, value: Any) -> tuple[str, Any]:
    """Return the setting that a value refers to in the end, and its name."""
    for _ in range(20):
        reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is None:
            break
        path, value = reference[1], value_at(plain, reference[1])
    return path, value


def _is_open(value: Any) -> bool:
    """Return whether a value is not known yet, or is made by Hydra."""
    if isinstance(value, dict):
        return "_target_" in value or any(_is_open(part) for part in value.values())
    if isinstance(value, list):
        return any(_is_open(part) for part in value)
    return isinstance(value, str) and ("${" in value or value == "???")
