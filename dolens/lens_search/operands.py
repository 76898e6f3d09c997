"""Operands hold lenses of a search to their specification.

An operand's deviation is zero where it holds; of a limit it is negative where there is room.
Lengths are in units of the focal length.
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, Arrangement
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
    beam: Tensor,
) -> tuple[Tangents, list[bool]]:
    """Return the deviations (O, ...) that need no real rays, and which of them are limits.

    Args:
        arrangement: the order.
        specification: what to keep.
        lenses: L of them.
        first_order: their paraxial numbers.
        aperture: radius of the entrance pupil over the focal length, (L,).
        field: tangent of the greatest field angle, (L,).
        beam: (L, S + 1), factor of the beam's paraxial height on each surface, and at the stop.
    """
    f, limits = specification.focal_length, specification.limits
    found = [Tangents.stacked([first_order.power - 1.0])]
    if limits.track is not None:
        found.append(Tangents.stacked([_sum(lenses.gaps) + lenses.image - limits.track / f]))
    curvatures = Tangents.stacked(lenses.curvatures)
    zero = 0.0 * lenses.image
    marginal = Tangents.stacked([zero + height for height in first_order.marginal])
    chief = Tangents.stacked(first_order.chief)
    heights = (marginal.abs() * aperture + chief.abs() * field) * beam.T[:-1]
    found.append((curvatures * heights).abs() - limits.aperture_over_radius)
    # Neighbouring surfaces do not come too near at the edge of the beam.
    spaces = list(_spaces(arrangement))
    before, behind = [n for n, _ in spaces], [n + 1 for n, _ in spaces]
    height = heights[before].maximum(heights[behind])
    thickness = Tangents.stacked([_sum([lenses.gaps[g] for g in gaps]) for _, gaps in spaces])
    edge = thickness + _sag(curvatures[behind], height) - _sag(curvatures[before], height)
    least = [
        limits.air_edge if arrangement.media_behind[n] == AIR else limits.glass_edge for n in before
    ]
    found.append(torch.tensor(least, dtype=torch.float64)[:, None] / f - edge)
    stop = arrangement.stop_place
    widest = limits.glass[1] if arrangement.within else limits.air[1]
    if widest is not None and 0 < stop < len(arrangement.sequence) - 1:
        around = Tangents.stacked([lenses.gaps[stop - 1] + lenses.gaps[stop]])
        found.append(around - widest / f)
    # The stop's opening is clear of the surfaces beside it.
    opening = Tangents.stacked([zero + first_order.stop_height]).abs() * (aperture * beam[:, -1])
    for neighbour, side in ((stop - 1, -1.0), (stop + 1, 1.0)):
        if 0 <= neighbour < len(arrangement.sequence):
            sag = _sag(curvatures[[arrangement.sequence[neighbour]]], opening)
            gap = Tangents.stacked([lenses.gaps[min(neighbour, stop)]])
            found.append(limits.air_edge / f - (gap + side * sag))
    every = Tangents(torch.cat([part.rows for part in found]))
    return every, [False] + [True] * (len(every.rows) - 1)


def _spaces(arrangement: Arrangement) -> Iterator[tuple[int, Sequence[int]]]:
    """Yield each surface but the last, and the gaps between it and the next one."""
    for number in range(arrangement.surfaces - 1):
        first = arrangement.sequence.index(number)
        yield number, range(first, arrangement.sequence.index(number + 1))


def _sum(gaps: Sequence[Tangents]) -> Tangents:
    total = gaps[0]
    for gap in gaps[1:]:
        total = total + gap
    return total


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
