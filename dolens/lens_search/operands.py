"""Operands hold lenses of a search to their specification.

An operand's deviation is zero where it holds; of a limit it is negative where there is room.
Lengths are in units of the focal length.
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.paraxial import LensNumbers, Paraxial
from dolens.lens_search.sags import asphere_slopes, sags
from dolens.lens_search.specification import Specification
from dolens.lens_search.tangents import Tangents

# Shares of the beam's height at which aspheres, and the spaces beside them, are looked at.
_ZONES = (0.35, 0.55, 0.7, 0.8, 0.9, 0.95, 1.0)
# What spaces have in reserve over the focal length: limits hold nearly, and spaces beside aspheres
# may be thinner between these heights.
_RESERVE, _RESERVE_OF_ASPHERES = 0.0002, 0.002


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
    spheres = [n for n in range(arrangement.surfaces) if not arrangement.is_asphere(n)]
    if spheres:
        steep = (curvatures[spheres] * heights[spheres]).abs()
        found.append(steep - limits.aperture_over_radius)
    if arrangement.aspheres:
        found.append(_slopes(arrangement, lenses, heights, limits.slope))
    # Neighbouring surfaces do not come too near in the beam, or at its edge.
    spaces = list(_spaces(arrangement))
    thickness = Tangents.stacked([_sum([lenses.gaps[g] for g in gaps]) for _, gaps in spaces])
    least = [
        limits.air_edge if arrangement.media_behind[n] == AIR else limits.glass_edge
        for n, _ in spaces
    ]
    least_over_f = torch.tensor(least, dtype=torch.float64)[:, None] / f
    least_over_f = least_over_f + (_RESERVE_OF_ASPHERES if arrangement.aspheres else _RESERVE)
    zones = len(_ZONES) if arrangement.aspheres else 1
    surfaces = [n for n, _ in spaces]
    before, behind = _to_the_edge(arrangement, heights, surfaces)
    sag = sags(arrangement, lenses, zones * surfaces, before)
    next_sag = sags(arrangement, lenses, zones * [n + 1 for n in surfaces], behind)
    room = (thickness + -least_over_f).rows.repeat(zones, 1, 1)
    found.append(sag - next_sag - Tangents(room))
    stop = arrangement.stop_place
    widest = limits.glass[1] if arrangement.within else limits.air[1]
    if widest is not None and 0 < stop < len(arrangement.sequence) - 1:
        around = Tangents.stacked([lenses.gaps[stop - 1] + lenses.gaps[stop]])
        found.append(around - widest / f)
    # The stop's opening is clear of the surfaces beside it.
    opening = Tangents.stacked([zero + first_order.stop_height]).abs() * (aperture * beam[:, -1])
    for neighbour, side in ((stop - 1, -1.0), (stop + 1, 1.0)):
        if 0 <= neighbour < len(arrangement.sequence):
            sag = sags(arrangement, lenses, [arrangement.sequence[neighbour]], opening)
            gap = Tangents.stacked([lenses.gaps[min(neighbour, stop)]])
            found.append(limits.air_edge / f - (gap + side * sag))
    last = arrangement.surfaces - 1
    if arrangement.is_asphere(last):
        # It may come nearer to the sensor than its vertex.
        at = Tangents(torch.cat([zone * heights[[last]].rows for zone in _ZONES]))
        sag = sags(arrangement, lenses, len(_ZONES) * [last], at)
        room = Tangents.stacked([lenses.image]).rows.repeat(len(_ZONES), 1, 1)
        found.append(limits.back_focus / f + _RESERVE_OF_ASPHERES - (Tangents(room) - sag))
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


def _to_the_edge(
    arrangement: Arrangement, heights: Tangents, surfaces: Sequence[int]
) -> tuple[Tangents, Tangents]:
    """Return the heights on surfaces and on those behind them at the zones, zone by zone; of a lens
    without aspheres at the edge alone.

    Glass ends with its beams: from there a flat leads out to the edge of the element, as high as
    the highest beam on its surfaces.  In air, spheres go on to the higher of the two beams, and
    aspheres, with their flats, to the lower of the two edges.
    """
    own, other = heights[list(surfaces)], heights[[n + 1 for n in surfaces]]
    glass = torch.tensor([arrangement.media_behind[n] != AIR for n in surfaces])[:, None, None]
    if not arrangement.aspheres:
        higher = own.maximum(other).rows
        return (
            Tangents(torch.where(glass, own.rows, higher)),
            Tangents(torch.where(glass, other.rows, higher)),
        )
    elements = _element_heights(arrangement, heights)
    higher_edge = elements[list(surfaces)]
    lower = _least(higher_edge, elements[[n + 1 for n in surfaces]])
    edge = torch.where(glass, higher_edge.rows, lower.rows)
    every = Tangents(torch.cat([zone * edge for zone in _ZONES]))
    return _least(every, own), _least(every, other)


def _element_heights(arrangement: Arrangement, heights: Tangents) -> Tangents:
    """Return the height of the element, or cemented group, that each surface is of."""
    found: list[Tensor] = []
    group: list[int] = []
    for number, behind in enumerate(arrangement.media_behind):
        group.append(number)
        if behind == AIR:
            highest = heights[[group[0]]]
            for other in group[1:]:
                highest = highest.maximum(heights[[other]])
            found += [highest.rows] * len(group)
            group = []
    return Tangents(torch.cat(found))


def _least(every: Tangents, own: Tangents) -> Tangents:
    """Return the lesser of heights at all zones and one of each surface."""
    repeated = own.rows.repeat(len(every.rows) // len(own.rows), 1, 1)
    return Tangents(torch.where((every.value <= repeated[:, 0])[:, None], every.rows, repeated))


def _slopes(
    arrangement: Arrangement, lenses: LensNumbers, heights: Tangents, limit: float
) -> Tangents:
    """Return how much steeper aspheres are than a limit, degrees, as shares of its tangent."""
    surfaces = arrangement.aspheres
    at = heights[surfaces]
    most = math.tan(math.radians(limit))
    every = Tangents(torch.cat([zone * at.rows for zone in _ZONES]))
    slope = asphere_slopes(arrangement, lenses, len(_ZONES) * surfaces, every)
    return slope.abs() / most - 1.0
