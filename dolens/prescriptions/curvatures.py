"""A prescription gives a curvature, or the radius of the same name."""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number


def radius_key(name: str) -> str:
    """Return `radius_x` for `curvature_x`."""
    return name.replace("curvature", "radius")


def curvature_from(row: Mapping[str, Any], name: str) -> float:
    """Return a curvature of a row, which gives it or the radius of the same name.

    Raises:
        InputError: both, neither, or a radius of 0.
    """
    key = radius_key(name)
    if row.get(name) is not None and row.get(key) is not None:
        raise InputError(f"give '{key}' or '{name}', not both")
    if row.get(name) is not None:
        return as_number(row[name], f"'{name}'")
    if row.get(key) is None:
        raise InputError(f"'{key}' is missing (mm; .inf for a plane)")
    radius = as_number(row[key], f"'{key}'", finite=False)
    if radius == 0.0:
        raise InputError(f"'{key}' is 0; write .inf for a plane")
    if math.isinf(1.0 / radius):
        raise InputError(f"'{key}' is {radius:g}, too small for a surface")
    return 1.0 / radius


def curvature_row(name: str, curvature: float) -> dict[str, float]:
    """Return the radius as a row writes it, or the curvature where a radius would lose a bit."""
    radius = math.inf if curvature == 0.0 else 1.0 / curvature
    # Rounding of 1/(1/c) loses a bit for some c: keep the parameter itself.
    return {radius_key(name): radius} if 1.0 / radius == curvature else {name: curvature}
