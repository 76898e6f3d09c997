"""The paraxial image of a file's surfaces, for programs that leave the last gap to a solve."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from dolens.errors import InputError


class ParaxialImage(NamedTuple):
    """A `ParaxialImage` is where an axial paraxial ray meets the axis behind the last surface.

    Attributes:
        distance: from the last vertex, mm along z.
        focal_length: of the surfaces for light from infinity, mm.
    """

    distance: float
    focal_length: float


def paraxial_image(
    curvatures: Sequence[float],
    gaps: Sequence[float],
    indices: Sequence[float],
    object_distance: float | None,
    place: str,
) -> ParaxialImage:
    """Trace the paraxial axial ray by n'u' = nu - y·c·(n' - n) and y' = y + t·u'.

    Args:
        curvatures: of the surfaces, 1/mm.
        gaps: behind all surfaces but the last, mm.
        indices: in front of the first surface and behind each; negative where light travels
            towards -z.
        object_distance: in front of the first surface, mm; None for infinity.
        place: name in messages.

    Raises:
        InputError: the light leaves the last surface parallel to the axis, or a number overflows.
    """
    height, reduced = _behind(curvatures, gaps, indices, 1.0, 0.0)
    power = -reduced
    if object_distance is not None:
        start = object_distance / indices[0]
        height, reduced = _behind(curvatures, gaps, indices, start, 1.0)
    if reduced == 0.0:
        raise InputError(f"{place}: the paraxial image is at infinity, and no solve can place it")
    distance = -height * indices[-1] / reduced
    if not math.isfinite(distance):
        raise InputError(f"{place}: numbers are too large to find the paraxial image")
    focal_length = indices[-1] / power if power else math.inf
    return ParaxialImage(distance, focal_length)


def _behind(
    curvatures: Sequence[float],
    gaps: Sequence[float],
    indices: Sequence[float],
    height: float,
    reduced: float,
) -> tuple[float, float]:
    """Return height and n·u of a ray behind the last surface."""
    for i, curvature in enumerate(curvatures):
        before, behind = indices[i], indices[i + 1]
        reduced -= height * curvature * (behind - before)
        if i < len(gaps):
            height += gaps[i] * reduced / behind
    return height, reduced
