"""A curved object is a plane to light that comes from its vertex, or from infinitely far away."""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError


def curved_object(
    prescription: Mapping[str, Any], shape: Mapping[str, Any], place: str
) -> list[str]:
    """Return a sentence about the curvature of an object, for the list of what is passed over;
    nothing of a plane one.

    Args:
        prescription: with the fields and `object_distance` of its file.
        shape: of the object, as a row of a prescription has it.
        place: the object's name in messages.

    Raises:
        InputError: the object is at a finite distance, and fields are off its axis.
    """
    radius = shape.get("radius", math.inf)
    if shape.get("curvature"):
        radius = 1.0 / shape["curvature"]
    departs = any(value for key, value in shape.items() if key[:1] in "ab" and key[1:].isdecimal())
    if math.isinf(radius) and not departs:
        return []
    what = "aspheric" if math.isinf(radius) else f"radius {radius:.6g} mm"
    if prescription.get("object_distance") is not None and not _is_axial(prescription):
        raise InputError(
            f"{place}: a curved object ({what}) is not held for fields off the axis (allowed: a "
            "plane, fields on the axis, or an object at infinity)"
        )
    return [f"the curvature of the object ({what}), of which light meets the vertex alone"]


def _is_axial(prescription: Mapping[str, Any]) -> bool:
    fields = prescription.get("fields") or {}
    kinds = fields.keys() - {"weights", "vignetting"}
    return not any(part for kind in kinds for point in fields[kind] for part in point)
