"""Operands hold lenses of a search to their specification.

An operand's deviation is zero where it holds; of a limit it is negative where there is room.  Lengths
are in units of the focal length.
"""

from collections.abc import Iterator, Sequence

from torch import Tensor

from dolens.lens_search.arrangement import AIR, STOP, Arrangement
from dolens.lens_search.paraxial import LensNumbers, Paraxial
from dolens.lens_search.specification import Specification
from dolens.lens_search.tangents import Tangents

# Beyond this part of a hemisphere the sag is continued along its tangent, to stay finite.
_STEEP = 0.98


def paraxial_operands(
    arrangement: Arrangement,
    specification: Specification,
    lenses: LensNumbers,
    first_order: Paraxial,
    aperture: Tensor,
    field: Tensor,
) -> tuple[list[Tangents], list[bool]]:
    """Return the deviations that need no real rays, and which of them are limits.

    Args:
        arrangement: the order.
        specification: what to keep.
        lenses: L of them.
        first_order: their paraxial numbers.
        aperture: radius of the entrance pupil over the focal length, (L,).
        field: tangent of the greatest field angle, (L,).
    """
    found, is_limit = [first_order.power - 1.0], [False]
    f = specification.focal_length
    limits = specification.limits
    if limits.track is not None:
        # From the first refracting surface: a stop in front of it is no part of the track.
        first = next(i for i, place in enumerate(arrangement.sequence) if place != STOP)
        length = _sum(lenses.gaps[first:]) + lenses.image
        found.append(length - limits.track / f)
    heights = [
        _magnitude(marginal) * aperture + chief.abs() * field
        for marginal, chief in zip(first_order.marginal, first_order.chief, strict=True)
    ]
    for curvature, height in zip(lenses.curvatures, heights, strict=True):
        found.append((curvature * height).abs() - limits.aperture_over_radius)
    for first, second, medium, thickness in _spaces(arrangement, lenses):
        least = (limits.air_edge if medium == AIR else limits.glass_edge) / f
        height = heights[first].maximum(heights[second])
        edge = thickness + (
            _sag(lenses.curvatures[second], height) - _sag(lenses.curvatures[first], height)
        )
        found.append(least - edge)
    is_limit += [True] * (len(found) - 1)
    return found, is_limit


def _spaces(
    arrangement: Arrangement, lenses: LensNumbers
) -> Iterator[tuple[int, int, int, Tangents]]:
    """Yield two neighbouring surfaces, what is between them, and their distance on the axis."""
    behind = arrangement.media_behind
    for number in range(arrangement.surfaces - 1):
        first = arrangement.sequence.index(number)
        second = arrangement.sequence.index(number + 1)
        yield number, number + 1, behind[number], _sum(lenses.gaps[first:second])


def _sum(gaps: Sequence[Tangents]) -> Tangents:
    total = gaps[0]
    for gap in gaps[1:]:
        total = total + gap
    return total


def _magnitude(height: Tangents | float) -> Tangents | float:
    return abs(height) if isinstance(height, float) else height.abs()


def _sag(curvature: Tangents, height: Tangents) -> Tangents:
    """Return the sag of a sphere at a height; beyond its steep part that of the tangent there."""
    steep = curvature * height
    inside = steep.clamp(-_STEEP, _STEEP)
    root = (1.0 - inside * inside).sqrt()
    sag = inside / (root + 1.0)
    beyond = steep - inside
    if bool((beyond.value != 0.0).any()):
        slope = 1.0 / (root.value * (1.0 + root.value))
        sag = sag + beyond * slope
    return height * sag
