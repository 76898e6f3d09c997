"""Lenses of the same form are told from others, and counted once.

Two lenses are of the same form where their drawings agree: drawn with the same focal length, no gap
and no place of the stop differs by more than a tolerance times the lens's length, no surface's
slope at the edge of the beam and no index by more than the tolerance.  (`form_coordinates` says
what is compared, and what has no meaning.)  So a lens at another scale is the same form, and so is
one that an optimizer has carried a little farther along the same valley, or that has a glass of
nearly the same index; another bending, another order of powers and another number of elements are
others.

The tolerance lies between two scales that are far apart.  Of 290 monochromatic quartets (f/3,
±15°) from random starts, optimised until nothing changed, any two in the same minimum differed by
0.002 or less, and any two in different minima by 0.15 or more: all tolerances between count 17
forms.  Designs that are not at their minimum yet, by 1 % of the merit, are some 0.01 to 0.05 away
from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.form_coordinates import (
    FormCoordinates,
    form_coordinates,
    is_reversible,
    lens_arrays,
    structure,
)
from dolens.optics.lens import Lens


@dataclass(frozen=True, eq=False)
class FoundLens:
    """Holds a lens that a search found.

    Attributes:
        lens: in double precision, with its stop, fields and wavelengths.
        merit: what the search made small; the least is the best.
        rms_spot_um: µm, the RMS spot radius of each field of the lens, in their order.
        start: number of the start that it came from.
        history: what was done to the start, in words: `inserted at 3`, `glass of 2`.
    """

    lens: Lens
    merit: float
    rms_spot_um: tuple[float, ...]
    start: int
    history: tuple[str, ...] = ()

    @property
    def mean_rms_spot_um(self) -> float:
        """Return the mean of the RMS spot radii over the fields, µm."""
        return sum(self.rms_spot_um) / len(self.rms_spot_um)


# A share of the lens's length, or a difference of slopes or indices.
TOLERANCE = 0.05
# Numbers that are compared before all others.
_FEW = 4


@dataclass(frozen=True, eq=False)
class Form:
    """A form is a group of found lenses that are the same design.

    Attributes:
        members: the lenses, the best first.
        places: where they stood in the list that was grouped, in the same order.
    """

    members: tuple[FoundLens, ...]
    places: tuple[int, ...]

    @property
    def best(self) -> FoundLens:
        """Return the lens of the least merit."""
        return self.members[0]

    @property
    def starts(self) -> tuple[int, ...]:
        """Return the numbers of the starts that led here, ascending, each once."""
        return tuple(sorted({member.start for member in self.members}))


def distinct(lenses: Sequence[FoundLens], tolerance: float = TOLERANCE) -> tuple[Form, ...]:
    """Group found lenses by form, the form with the best lens first.

    Args:
        lenses: in any order; lenses with a merit that is not finite are left out.
        tolerance: see the module.

    Raises:
        InputError: a lens with coordinate breaks, mirrors or no focal length, or a tolerance that
            is not positive.
    """
    kinds: dict[tuple[bool, ...], list[int]] = {}
    for place, found in enumerate(lenses):
        if torch.isfinite(torch.tensor(found.merit)):
            kinds.setdefault(structure(found.lens), []).append(place)
    groups: list[list[int]] = []
    for places in kinds.values():
        alike = [lenses[place].lens for place in places]
        merit = torch.tensor([lenses[place].merit for place in places], dtype=torch.float64)
        turned = None
        if any(is_reversible(lens) for lens in alike):
            turned = _coordinates(alike, [is_reversible(lens) for lens in alike])
        numbers = form_numbers(_coordinates(alike), merit, tolerance, turned)
        order = merit.argsort(stable=True)
        for number in range(int(numbers.max()) + 1):
            members = order[numbers[order] == number].tolist()
            groups.append([places[member] for member in members])
    groups.sort(key=lambda group: lenses[group[0]].merit)
    return tuple(Form(tuple(lenses[place] for place in g), tuple(g)) for g in groups)


def form_numbers(
    coordinates: FormCoordinates,
    merit: Tensor,
    tolerance: float = TOLERANCE,
    reversed_coordinates: FormCoordinates | None = None,
) -> Tensor:
    """Return the number of the form of each lens, (L,), int64; 0 is the form of the best lens.

    The lenses are taken from the best on.  Each one that is no nearer than the tolerance to the
    best lens of a form begins a new form; the others belong to the first form that they are near.
    Merits that are infinite or NaN come last.

    Args:
        coordinates: of L lenses of one structure.
        merit: (L,), the least is the best.
        tolerance: see the module.
        reversed_coordinates: the same lenses turned end for end, which are the same lenses too.

    Raises:
        InputError: the tolerance is not positive.
    """
    if not tolerance > 0.0:
        raise InputError(f"tolerance: must be a positive number, not {tolerance!r}")
    order = torch.where(torch.isnan(merit), torch.inf, merit.double()).argsort(stable=True)
    ways = [coordinates] + ([] if reversed_coordinates is None else [reversed_coordinates])
    neighbours = [_Neighbours(way, tolerance) for way in ways]
    numbers = torch.full((len(merit),), -1, dtype=torch.int64)
    wanted = torch.ones_like(numbers, dtype=torch.bool)
    number = 0
    for best in order.tolist():
        if not bool(wanted[best]):
            continue
        one = coordinates.taken([best])
        for near in neighbours:
            places = near.of(one, wanted)
            numbers[places], wanted[places] = number, False
        # A lens is of its own form, even where its numbers are no numbers.
        numbers[best], wanted[best] = number, False
        number += 1
    return numbers


class _Neighbours:
    """Finds the lenses that are near one lens.

    Most lenses differ in a few numbers already: they are kept in the order of the number that
    differs most, and those near in it are compared in the next few before all others.

    Args:
        coordinates: of all lenses.
        tolerance: how near.
    """

    def __init__(self, coordinates: FormCoordinates, tolerance: float) -> None:
        self.coordinates, self.tolerance = coordinates, tolerance
        numbers = coordinates.numbers.nan_to_num()
        columns = (numbers - numbers.mean(0)).square().sum(0).argsort(descending=True)
        self.columns = columns[:_FEW]
        self.few = numbers[:, self.columns].contiguous()
        self.sorted, self.places = self.few[:, 0].sort()

    def of(self, one: FormCoordinates, wanted: Tensor) -> Tensor:
        """Return the places of the wanted lenses, (L,), that are near."""
        own = one.numbers[0, self.columns]
        first = int(torch.searchsorted(self.sorted, own[:1] - self.tolerance))
        last = int(torch.searchsorted(self.sorted, own[:1] + self.tolerance, right=True))
        places = self.places[first:last]
        places = places[(self.few[places] - own).abs().amax(1) <= self.tolerance]
        places = places[wanted[places]]
        return places[form_distances(self.coordinates.taken(places), one) <= self.tolerance]


def form_distances(coordinates: FormCoordinates, others: FormCoordinates) -> Tensor:
    """Return the distances (L,) of lenses from as many others, or from one.

    It is the largest difference of a gap, over the mean length of both lenses, a slope or an index.
    """
    whole = 0.5 * (coordinates.whole + others.whole)
    lengths = (coordinates.lengths - others.lengths).abs().amax(1) / whole
    return torch.maximum(lengths, (coordinates.numbers - others.numbers).abs().amax(1))


def lens_distance(lens: Lens, other: Lens) -> float:
    """Return the distance between the forms of two lenses; infinite where one has other elements.

    Raises:
        InputError: a lens with coordinate breaks, mirrors or no focal length.
    """
    if structure(lens) != structure(other):
        return float("inf")
    there = _coordinates([other])
    ways = [_coordinates([lens])]
    if is_reversible(lens) and is_reversible(other):
        ways.append(_coordinates([lens], [True]))
    return min(float(form_distances(way, there)) for way in ways)


def _coordinates(lenses: Sequence[Lens], turned: Sequence[bool] | None = None) -> FormCoordinates:
    """Return the coordinates of lenses with the same elements, whose idle surfaces may differ."""
    found = []
    for place, lens in enumerate(lenses):
        reverse = turned is not None and turned[place]
        found.append(form_coordinates(lens_arrays(lens, reverse)))
    return FormCoordinates(
        torch.cat([each.lengths for each in found]),
        torch.cat([each.numbers for each in found]),
        torch.cat([each.whole for each in found]),
    )
