"""A search may begin elsewhere than at the prescription."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError, check_keys
from dolens.optics.lens import Lens
from dolens.optics.parameter_units import to_lens_units

_KEYS = ("multiply", "add", "relative", "absolute")
_WITHOUT_UNIT = ("multiply", "relative")


def start_values(
    lens: Lens, settings: Mapping[str, float | Mapping[str, Any]], generator: torch.Generator
) -> dict[str, Tensor]:
    """Return parameters of a lens to begin with; the lens is not changed.

    Args:
        lens: whose parameters are named.
        settings: pattern → a number; or `multiply` and `add`, applied in this order; or `relative`
            and `absolute`, standard deviations of normal errors, as a share of the parameter and in
            its unit.  Numbers are in the units of files, degrees for tilts.
            Later patterns go on from what earlier ones made.
        generator: of the errors.

    Returns:
        name → value, of the parameters that a pattern names.

    Raises:
        InputError: an unknown pattern or key, or a value that is no finite number.
    """
    found: dict[str, Tensor] = {}
    for pattern, change in settings.items():
        written = _numbers(pattern, change)
        for name, parameter in lens.variables([pattern]).items():
            numbers = {
                key: value if key in _WITHOUT_UNIT else to_lens_units(name, value)
                for key, value in written.items()
            }
            value = found.get(name, parameter.detach().clone())
            if "value" in numbers:
                found[name] = torch.full_like(value, numbers["value"])
                continue
            errors = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value)
            value = value * numbers.get("multiply", 1.0) + numbers.get("add", 0.0)
            spread = numbers.get("relative", 0.0) * value + numbers.get("absolute", 0.0)
            found[name] = value + spread * errors
    return found


def _numbers(pattern: str, change: object) -> dict[str, float]:
    given: dict[str, Any] = dict(change) if isinstance(change, Mapping) else {"value": change}
    if isinstance(change, Mapping):
        check_keys(change, _KEYS, f"start '{pattern}'")
    for key, value in given.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise InputError(f"start '{pattern}': {key} must be a finite number, not {value!r}")
    return {key: float(value) for key, value in given.items()}
