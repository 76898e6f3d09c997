"""Lenses that a search grows: random ones, and designs with an element put in or taken out.

Powers of random lenses' elements, their bendings, thicknesses and air spaces are drawn; the
curvatures are then scaled until the focal length is right.  Of many such lenses those are kept
whose back focus, beam and Petzval sum are within reach, the best of them first.

A thin shell with both faces like the surface that it touches bends nearly no ray.  A minimum
with such a shell put in is close to a saddle of the problem with one element more, and the two
sides of the saddle lead to different minima.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.paraxial import petzval_sum
from dolens.lens_search.specification import Specification

# Lenses that are drawn for one that is kept.
DRAWN = 24
# Newton's steps for the factor of the curvatures.
_STEPS = 12
# Of axial colour in the strain: that of a singlet of crown is worth 0.25.
_COLOUR = 30.0


def random_starts(
    merit: SearchMerit, count: int, generator: torch.Generator, drawn: int = DRAWN
) -> Tensor:
    """Return variables u of up to `count` starts, (n, P), the most promising first.

    Args:
        merit: knows the arrangement and the specification.
        count: how many.
        generator: of the random numbers.
        drawn: lenses that are drawn for one that is kept.
    """
    lenses = merit.completed(_drawn(merit, drawn * count, generator), generator)
    scaled = _with_focal_length(merit, lenses)
    rank = _rank(merit, scaled)
    best = rank.argsort()[:count]
    return scaled[best[torch.isfinite(rank[best])]]


def _drawn(merit: SearchMerit, count: int, generator: torch.Generator) -> Tensor:
    """Draw lenses whose focal length is not yet right."""
    arrangement = merit.arrangement

    def uniform(low: float, high: float) -> Tensor:
        drawn = torch.rand(count, generator=generator, dtype=torch.float64)
        return low + (high - low) * drawn

    def logarithmic(low: float, high: float) -> Tensor:
        return uniform(math.log(low), math.log(high)).exp()

    lower, upper = merit.bounds()
    columns = []
    previous: Tensor | None = None
    for behind in arrangement.media_behind:
        # An element's back follows from its front by a drawn power; cemented ones share a face.
        curvature = uniform(-2.5, 2.5) if previous is None else previous + uniform(-4.0, 4.0)
        columns.append(curvature)
        previous = None if behind == AIR else curvature
    s = arrangement.surfaces
    for gap, medium in enumerate(arrangement.gap_media, s):
        low = max(float(lower[gap]), 1e-3)
        high = min(float(upper[gap]), 0.3 if medium != AIR else 0.4)
        columns.append(logarithmic(low, max(high, 1.001 * low)))
    low = max(float(lower[arrangement.image_column]), 0.05)
    columns.append(uniform(low, max(1.2, 1.5 * low)))
    # Aspheres begin as parabolas.
    columns += [torch.zeros(count, dtype=torch.float64)] * sum(arrangement.terms)
    return torch.stack(columns, -1)


def _with_focal_length(merit: SearchMerit, drawn: Tensor) -> Tensor:
    """Scale the curvatures of each lens until its power is one, by the secant method."""
    s = merit.arrangement.surfaces

    def power(factor: Tensor) -> Tensor:
        return merit.paraxial_of(scaled(factor))[0]

    def scaled(factor: Tensor) -> Tensor:
        return torch.cat([drawn[:, :s] * factor[:, None], drawn[:, s:]], 1)

    old, new = torch.full((len(drawn),), 0.5).to(drawn), torch.ones(len(drawn)).to(drawn)
    at_old, at_new = power(old) - 1.0, power(new) - 1.0
    for _ in range(_STEPS):
        change = at_new - at_old
        step = torch.where(change.abs() > 1e-12, -at_new * (new - old) / change, 0.0)
        old, at_old = new, at_new
        new = (new + step.clamp(-0.5, 0.5)).clamp(-4.0, 4.0)
        at_new = power(new) - 1.0
    found = scaled(new)
    found[at_new.abs() > 1e-3] = torch.nan
    back_focus = merit.paraxial_of(found)[2]
    lower, upper = merit.bounds()
    image = merit.arrangement.image_column
    within = (back_focus >= lower[image]) & (back_focus <= upper[image])
    found[:, image] = torch.where(within, back_focus, torch.nan)
    return found


def _rank(merit: SearchMerit, lenses: Tensor) -> Tensor:
    """Return how promising lenses are, the least first; infinite where one is out of reach.

    It is what strains a lens: the squares of the marginal and the chief ray's bending at each
    surface at full aperture and field, and the Petzval sum.
    """
    specification = merit.specification
    numbers, found = merit.first_order(lenses)
    aperture = 0.5 / specification.f_number
    field = math.tan(math.radians(specification.fields[-1]))
    strain = 4.0 * petzval_sum(numbers).square() + (_COLOUR * merit.colour(lenses)).square()
    good = torch.isfinite(lenses).all(-1)
    for curvature, marginal, chief in zip(
        numbers.curvatures, found.marginal, found.chief, strict=True
    ):
        height = aperture * abs(marginal) + field * abs(chief)
        steep = curvature * height
        good &= (steep.abs() < 0.8) & (height < 1.0)
        strain = strain + steep.square()
    limit = specification.limits.track
    if limit is not None:
        s = merit.arrangement.surfaces
        lengths = lenses[:, s : merit.arrangement.image_column + 1]
        good &= lengths.sum(-1) < limit / specification.focal_length
    return torch.where(good & torch.isfinite(strain), strain, torch.inf)


# How far a shell's second curvature is moved off the saddle, times the focal length.
_OFF_SADDLE = 0.02


@dataclass(frozen=True)
class Neighbours:
    """Designs that others led to.

    Attributes:
        arrangement: that they have.
        values: u, (n, P).
        parents: (n,), int64, rows of the designs that they come from.
        words: what was done.
    """

    arrangement: Arrangement
    values: Tensor
    parents: Tensor
    words: str


@dataclass(frozen=True)
class _Group:
    """Curvatures, aspheric coefficients and thicknesses of one cemented group, each (n,)."""

    curvatures: Sequence[Tensor]
    coefficients: Sequence[Sequence[Tensor]]
    thicknesses: Sequence[Tensor]

    @property
    def length(self) -> Tensor:
        return torch.stack(list(self.thicknesses)).sum(0)


@dataclass(frozen=True)
class _Parts:
    """The numbers of n lenses by groups and the air spaces around them.

    Attributes:
        groups: from the front.
        spaces: one more than groups: the gaps in front of each and behind the last; the one with
            the stop has one more than it would have without.
        image: from the last of the sequence to the sensor.
        stop: behind how many groups the stop stands.
    """

    groups: Sequence[_Group]
    spaces: Sequence[Sequence[Tensor]]
    image: Tensor
    stop: int

    @property
    def arrangement(self) -> Arrangement:
        groups = tuple(len(group.thicknesses) for group in self.groups)
        terms = tuple(len(own) for group in self.groups for own in group.coefficients)
        return Arrangement(groups, self.stop, terms=terms if any(terms) else ())

    def values(self) -> Tensor:
        """Return u, (n, P)."""
        curvatures = [c for group in self.groups for c in group.curvatures]
        gaps = list(self.spaces[0])
        for group, space in zip(self.groups, self.spaces[1:], strict=True):
            gaps += [*group.thicknesses, *space]
        bent = [a for group in self.groups for own in group.coefficients for a in own]
        return torch.stack([*curvatures, *gaps, self.image, *bent], -1)


def _parts(arrangement: Arrangement, values: Tensor) -> _Parts:
    """Return the numbers of lenses u (n, P) by groups."""
    columns = list(values.unbind(-1))
    image = arrangement.image_column
    curvatures, rest = columns[: arrangement.surfaces], columns[arrangement.surfaces : image]
    bent = [[columns[n] for n in own] for own in arrangement.coefficient_columns]
    last = len(arrangement.groups)
    groups, spaces = [], []
    for number in range(last + 1):
        within = 0 if number in (0, last) else 1
        size = within + (1 if number == arrangement.stop else 0)
        spaces.append(rest[:size])
        rest = rest[size:]
        if number < last:
            count = arrangement.groups[number]
            groups.append(_Group(curvatures[: count + 1], bent[: count + 1], rest[:count]))
            curvatures, bent, rest = curvatures[count + 1 :], bent[count + 1 :], rest[count:]
    return _Parts(groups, spaces, columns[image], arrangement.stop)


def inserted(
    arrangement: Arrangement, values: Tensor, specification: Specification
) -> list[Neighbours]:
    """Put a shell on each surface that bounds an air space, on both sides of the saddle.

    Args:
        arrangement: of the designs.
        values: u, (n, P).
        specification: gives the least thickness of glass and air.
    """
    f, limits = specification.focal_length, specification.limits
    parts = _parts(arrangement, values)
    like = torch.ones_like(parts.image)
    thickness, air = limits.glass[0] / f * like, max(limits.air[0], 1e-3 * f) / f * like
    found = []
    surface = 0
    for number, group in enumerate(parts.groups):
        ends = ((number, False, 0), (number + 1, True, -1))
        for space, behind, end in ends:
            curvature, bent = group.curvatures[end], group.coefficients[end]
            at = surface + (len(group.curvatures) if behind else 1)
            for side in (_OFF_SADDLE, -_OFF_SADDLE):
                shell = _Group([curvature, curvature + side], [bent, bent], [thickness])
                made = _with_group(parts, space, behind, shell, air)
                words = f"shell {'behind' if behind else 'before'} surface {at}"
                found.append(_neighbours(made, len(values), words))
        surface += len(group.curvatures)
    return found


def _with_group(parts: _Parts, space: int, behind: bool, group: _Group, air: Tensor) -> _Parts:
    """Put a group into a space, behind the group in front of it or before the next one."""
    old = parts.spaces[space]
    around = [[air], old] if behind else [old, [air]]
    if behind and space == len(parts.groups) and parts.stop != space:
        around = [[air], []]
    in_front = space < parts.stop or (space == parts.stop and behind)
    image = parts.image
    if space == len(parts.groups) and parts.stop != space:
        # Behind the last surface: the shell stands in the way to the sensor.
        image = image - air - group.length
    return _Parts(
        [*parts.groups[:space], group, *parts.groups[space:]],
        [*parts.spaces[:space], *around, *parts.spaces[space + 1 :]],
        image,
        parts.stop + (1 if in_front else 0),
    )


def taken_out(arrangement: Arrangement, values: Tensor) -> list[Neighbours]:
    """Take out each group in turn; what it leaves is air.

    Args:
        arrangement: of the designs, two groups or more.
        values: u, (n, P).
    """
    parts = _parts(arrangement, values)
    last = len(parts.groups) - 1
    found = []
    for number, group in enumerate(parts.groups):
        front, back = list(parts.spaces[number]), list(parts.spaces[number + 1])
        image, stop = parts.image, parts.stop
        if stop > number:
            stop -= 1
        if number == 0:
            # The lens begins later; a stop in front of it stays where it is.
            space = [front[0] + group.length + back[0]] if parts.stop == 0 else back[1:]
        elif number == last:
            space = front[:-1]
            if parts.stop == last + 1:
                space = [front[0] + group.length + back[0]]
            else:
                image = image + front[-1] + group.length
        elif parts.stop == number:
            space = [front[0], front[1] + group.length + back[0]]
        elif parts.stop == number + 1:
            space = [front[0] + group.length + back[0], back[1]]
        else:
            space = [front[0] + group.length + back[0]]
        made = _Parts(
            [*parts.groups[:number], *parts.groups[number + 1 :]],
            [*parts.spaces[:number], space, *parts.spaces[number + 2 :]],
            image,
            stop,
        )
        found.append(_neighbours(made, len(values), f"element {number + 1} out"))
    return found


def _neighbours(parts: _Parts, count: int, words: str) -> Neighbours:
    return Neighbours(parts.arrangement, parts.values(), torch.arange(count), words)
