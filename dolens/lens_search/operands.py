"""Operands hold lenses of a search to their specification: focal length, spaces, distortion.

An operand's deviation is zero where it holds; of a limit it is negative where there is room.
Lengths are in units of the focal length.  A sphere has the sag h·ch/(1 + √(1 - c²h²)) at the
height h, an asphere c·h²/2 + a4·h⁴ + a6·h⁶ + ….
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.paraxial import LensNumbers, Paraxial, Tangents
from dolens.lens_search.search_rays import SearchRays
from dolens.lens_search.specification import Specification
from dolens.optics.lens_family import FamilyRays, FamilySums, LensFamily

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


# Beyond this part of a hemisphere the sag is continued along its tangent, to stay finite.
_STEEP = 0.98


def sags(
    arrangement: Arrangement, lenses: LensNumbers, surfaces: Sequence[int], heights: Tangents
) -> Tangents:
    """Return the sags of n surfaces at a height each.

    Args:
        arrangement: of the lenses.
        lenses: whose curvatures and coefficients are the variables themselves.
        surfaces: n numbers, from 0.
        heights: (n, 1 + P, L).
    """
    curvatures = Tangents.stacked([lenses.curvatures[n] for n in surfaces])
    rows = [n for n, surface in enumerate(surfaces) if arrangement.is_asphere(surface)]
    if not rows:
        return sphere_sags(curvatures, heights)
    if len(rows) == len(surfaces):
        return _polynomials(arrangement, lenses, surfaces, heights, slopes=False)
    others = [n for n in range(len(surfaces)) if n not in rows]
    found = torch.empty_like(heights.rows)
    found[others] = sphere_sags(curvatures[others], heights[others]).rows
    of_rows = [surfaces[n] for n in rows]
    found[rows] = _polynomials(arrangement, lenses, of_rows, heights[rows], slopes=False).rows
    return Tangents(found)


def asphere_slopes(
    arrangement: Arrangement, lenses: LensNumbers, surfaces: Sequence[int], heights: Tangents
) -> Tangents:
    """Return dz/dh of n aspheres at a height each; arguments as those of `sags`."""
    return _polynomials(arrangement, lenses, surfaces, heights, slopes=True)


def sphere_sags(curvature: Tangents, height: Tangents) -> Tangents:
    """Return the sags of spheres; beyond their steep part those of the tangent there."""
    steep = curvature * height
    inside = steep.clamp(-_STEEP, _STEEP)
    root = (1.0 - inside * inside).sqrt()
    sag = inside / (root + 1.0)
    beyond = steep - inside
    if bool((beyond.value != 0.0).any()):
        slope = 1.0 / (root.value * (1.0 + root.value))
        sag = sag + beyond * slope
    return height * sag


def _polynomials(
    arrangement: Arrangement,
    lenses: LensNumbers,
    surfaces: Sequence[int],
    heights: Tangents,
    slopes: bool,
) -> Tangents:
    """Return the sags of aspheres, or their slopes.

    Each is Σ b·v·h^q over the variables v of its surface, so that its derivatives are b·h^q with
    respect to these, and Σ q·b·v·h^(q-1) times those of the height.
    """
    h = heights.value
    known = sorted(set(surfaces))
    terms = max(len(lenses.coefficients[n]) for n in known)
    numbers = torch.zeros((len(known), 1 + terms, h.shape[-1]), dtype=h.dtype)
    for row, n in enumerate(known):
        for term, number in enumerate((lenses.curvatures[n], *lenses.coefficients[n])):
            numbers[row, term] = number.value
    numbers = numbers[[known.index(n) for n in surfaces]]
    # Orders q = 2, 4, ... of sags, and 1, 3, ... of slopes.
    order = torch.arange(2.0, 2.0 * terms + 3.0, 2.0, dtype=h.dtype)
    factor = torch.ones_like(order)
    factor[0] = 0.5
    if slopes:
        factor, order = factor * order, order - 1.0
    first = torch.ones_like(h) if slopes else h
    squares = (h * h)[:, None].expand(-1, terms, -1)
    lower = torch.cat([first[:, None], squares], 1).cumprod(1)  # h^(q-1)
    lower = lower * factor[:, None]
    partial = lower * h[:, None]
    rows = heights.rows * (lower * numbers * order[:, None]).sum(1)[:, None]
    rows[:, 0] = (partial * numbers).sum(1)
    places = [
        (row, 1 + column, term)
        for row, n in enumerate(surfaces)
        for term, column in enumerate((n, *arrangement.coefficient_columns[n]))
    ]
    at, columns, which = (torch.tensor(place) for place in zip(*places, strict=True))
    rows[at, columns] += partial[at, which]
    return Tangents(rows)


# Limits are aimed at from within: the rays that a lens is checked with lie between those here, and
# the distortion of a lens with aspheres waves between them.
_WITHIN, _WITHIN_WAVES = 0.999, 0.985


def distortion(
    sums: FamilySums, rays: SearchRays, ideal: Tensor, limit: float, waves: bool
) -> tuple[Tensor, Tensor]:
    """Return how far distortion exceeds its limit (L, C), and derivatives (L, C, P + 1) with
    respect to the family's variables.

    Args:
        sums: of the rays, whose last groups are the chief rays.
        rays: C of them are chief rays.
        ideal: heights f·tan θ of the chief rays, mm, (L, C).
        limit: greatest |h/h₀ - 1|.
        waves: whether there are aspheres.
    """
    share = sums.group_residual[:, rays.fields :, 1] / ideal
    row = sums.group_jacobian[:, rays.fields :, 1] / ideal[..., None]
    return share.abs() - (_WITHIN_WAVES if waves else _WITHIN) * limit, share.sign()[
        ..., None
    ] * row


def chief_ray_angles(
    family: LensFamily, values: Tensor, rays: FamilyRays, limit: float
) -> tuple[Tensor, Tensor]:
    """Return by how much the sines of chief rays' angles at the sensor exceed that of their limit
    (L, C), and derivatives (L, C, P + 1) with respect to the family's variables.

    Args:
        family: of the lenses.
        values: the family's variables, (L, P + 1).
        rays: the chief rays, C of each lens.
        limit: greatest angle with the sensor's normal, degrees.
    """
    found = family.jacobians(values, rays, ("m",))
    sine = found.values[:, 0]
    most = math.sin(math.radians(_WITHIN * limit))
    return sine.abs() - most, sine.sign()[..., None] * found.derivatives[:, 0].mT
