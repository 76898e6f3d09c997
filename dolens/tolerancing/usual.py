"""The usual tolerances are those of a lens that nobody has given any.

Every group of cemented glass may tilt by 0.05°, and be moved by 0.02 mm; glass may be 0.02 mm too
thick, and curvatures 0.1 % too strong.  Of a small lens all lengths are less: 0.25 % of its largest
clear diameter.  All are uniform over ± the half-range.
"""

import copy
from collections.abc import Sequence
from typing import Any

from torch import nn

from dolens.optics.elements import Element
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass

# Half-ranges: degrees, mm, a share of the curvature; and mm as a share of the largest diameter.
_TILT, _LENGTH, _CURVATURE, _OF_DIAMETER = 0.05, 0.02, 0.001, 0.0025


def with_glass_elements(lens: Lens) -> Lens:
    """Return a copy of a lens in which every group of cemented glass is an element.

    Elements that it has already stay.

    Args:
        lens: stays as it is.
    """
    lens = copy.deepcopy(lens).requires_grad_(True)
    taken = {n for e in lens.elements.values() for n in range(e.first, e.last + 1)}
    glass = [is_glass(medium) for medium in lens.materials]
    first = None
    for n in range(1, len(lens.surfaces) + 1):
        if first is None and glass[n]:
            first = n
        if first is not None and not glass[n]:
            if taken.isdisjoint(range(first, n + 1)):
                name = _free(f"element {first}–{n}", lens.elements)
                lens.elements[name] = Element(first, n, dtype=lens.dtype)
            first = None
    return lens


def usual_tolerances(lens: Lens) -> dict[str, Any]:
    """Return the usual tolerances of a lens and its elements, as `tolerances_from` takes them."""
    length = _length(lens)
    given: dict[str, Any] = {}
    if lens.elements:
        given["elements.*.tilt_[xy]"] = _TILT
        given["elements.*.decenter_[xy]"] = length
        given["elements.*.shift_z"] = length
    for n, medium in enumerate(lens.materials[1:-1], 1):
        if is_glass(medium):
            given[f"thicknesses.{n}"] = length
    for key, surface in lens.surfaces.items():
        curvature = getattr(surface, "curvature", None)
        if curvature is not None and float(curvature.detach()) != 0.0:
            given[f"surfaces.{key}.curvature"] = {"half_range": _CURVATURE, "relative": True}
    return given


def usual_tolerances_text(lens: Lens) -> str:
    """Return a sentence that says what the usual tolerances of a lens are."""
    length = _length(lens)
    return (
        f"Usual tolerances, uniform over ± the half-range: elements tilt by {_TILT:g}°, and are "
        f"decentred and shifted by {length:g} mm; glass thickness {length:g} mm; curvatures "
        f"{100 * _CURVATURE:g} %."
    )


def fields_all_around(
    fields: Sequence[Sequence[float]], weights: Sequence[float]
) -> dict[tuple[float, float], float]:
    """Return fields on all four sides of the axis, with their weights: a perturbed lens has no
    symmetry.

    Each of the given fields hands its weight on in equal parts: the axis to one, others to four.

    Args:
        fields: (x, y) of each, degrees or mm.
        weights: of each.
    """
    found: dict[tuple[float, float], float] = {}
    for (x, y), weight in zip(fields, weights, strict=True):
        for point in ((x, y), (-x, -y), (y, -x), (-y, x)):
            there = (point[0] + 0.0, point[1] + 0.0)
            found[there] = found.get(there, 0.0) + 0.25 * weight
    return {point: weight for point, weight in found.items() if weight > 0.0}


def _length(lens: Lens) -> float:
    largest = 2.0 * max(surface.semi_diameter for surface in lens.surfaces.values())
    return min(_LENGTH, float(f"{_OF_DIAMETER * largest:.1g}"))


def _free(name: str, elements: nn.ModuleDict) -> str:
    return name if name not in elements else _free(f"{name}'", elements)
