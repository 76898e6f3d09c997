"""Designs are what the steps of a search hand on: many lenses of one arrangement."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.lens_search.arrangement import STOP, Arrangement
from dolens.lens_search.form_coordinates import ZONES, FormArrays, departures, form_coordinates
from dolens.lens_search.forms import TOLERANCE, form_numbers
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.paraxial import LensNumbers


@dataclass(frozen=True)
class Designs:
    """Lenses of one arrangement.

    Attributes:
        arrangement: the order of their elements.
        values: u, (n, P).
        spots: RMS spot radii, mm, (n, F).
        violation: (n,), of the worst operand.
        starts: (n,), int64, numbers of the starts that they came from.
        history: of each, what was done to the start, in words.
    """

    arrangement: Arrangement
    values: Tensor
    spots: Tensor
    violation: Tensor
    starts: Tensor
    history: tuple[tuple[str, ...], ...]

    @property
    def merit(self) -> Tensor:
        """Return the mean of the RMS spot radii, mm, (n,)."""
        return self.spots.mean(-1)

    def chosen(self, rows: Tensor) -> "Designs":
        """Return some of them, by number or by a mask."""
        rows = torch.arange(len(self.values))[rows]
        return Designs(
            self.arrangement,
            self.values[rows],
            self.spots[rows],
            self.violation[rows],
            self.starts[rows],
            tuple(self.history[row] for row in rows.tolist()),
        )

    @staticmethod
    def joined(parts: Sequence["Designs"]) -> "Designs":
        """Return all designs of several, which have one arrangement."""
        return Designs(
            parts[0].arrangement,
            torch.cat([part.values for part in parts]),
            torch.cat([part.spots for part in parts]),
            torch.cat([part.violation for part in parts]),
            torch.cat([part.starts for part in parts]),
            tuple(words for part in parts for words in part.history),
        )

    def keeping(self, tolerance: float) -> "Designs":
        """Return those whose operands hold within a tolerance, and whose rays all pass."""
        return self.chosen((self.violation <= tolerance) & torch.isfinite(self.merit))

    def form_numbers(
        self, merit: SearchMerit, by_glass: bool = False, tolerance: float = TOLERANCE
    ) -> Tensor:
        """Return the number of each design's form, (n,), int64, from 0.

        Args:
            merit: of this arrangement.
            by_glass: whether lenses whose glasses have other names are of other forms.
            tolerance: see `dolens.lens_search.forms`.
        """
        coordinates, ranked = form_coordinates(self.arrays(merit)), self.ranked_merit(merit)
        if not by_glass:
            return form_numbers(coordinates, ranked, tolerance)
        numbers, first = torch.zeros(len(ranked), dtype=torch.int64), 0
        kinds = merit.kinds(self.values)
        for kind in kinds.unique().tolist():
            mine = (kinds == kind).nonzero()[:, 0]
            own = form_numbers(coordinates.taken(mine), ranked[mine], tolerance)
            numbers[mine] = first + own
            first += int(own.max()) + 1
        return numbers

    def ranked_merit(self, merit: SearchMerit) -> Tensor:
        """Return the merit with what glasses cost, mm, (n,): the order of designs."""
        return self.merit * merit.cost_factor(self.values)

    def of_distinct_forms(
        self, merit: SearchMerit, by_glass: bool = False, tolerance: float = TOLERANCE
    ) -> "Designs":
        """Return the best of each form, the best first; see `form_numbers`."""
        if not len(self.values):
            return self
        numbers = self.form_numbers(merit, by_glass, tolerance)
        order = self.ranked_merit(merit).argsort(stable=True)
        seen: set[int] = set()
        first = [
            row
            for row, number in zip(order.tolist(), numbers[order].tolist(), strict=True)
            if number not in seen and not seen.add(number)  # type: ignore[func-returns-value]
        ]
        return self.chosen(torch.tensor(first, dtype=torch.int64))

    def arrays(self, merit: SearchMerit) -> FormArrays:
        """Return them as plain numbers of their sequences, for a comparison of forms."""
        a = self.arrangement
        numbers, found = merit.first_order(self.values)
        of_media = merit.dispersions(self.values)
        radius = 0.5 / merit.specification.f_number
        field = float(merit.rays.tangent.max())
        zero = torch.zeros_like(numbers.image)
        curvatures, heights, bent, indices, spread = [], [], [], [zero + 1.0], [zero]
        none = torch.stack([zero] * len(ZONES), -1)
        behind, falls = zero + 1.0, zero
        for place in a.sequence:
            if place == STOP:
                curvatures.append(zero)
                heights.append(zero)
                bent.append(none)
            else:
                curvatures.append(numbers.curvatures[place])
                height = radius * abs(found.marginal[place]) + field * abs(found.chief[place])
                heights.append(zero + height)
                bent.append(self._departures(numbers, place, zero + height))
                behind = zero + numbers.indices[place + 1]
                falls = zero if of_media is None else of_media[:, place + 1]
            indices.append(behind)
            spread.append(falls)
        return FormArrays(
            torch.stack(curvatures, -1),
            torch.stack([*numbers.gaps, numbers.image], -1),
            torch.stack(indices, -1),
            torch.stack(heights, -1),
            1.0 / found.power,
            None if of_media is None else torch.stack(spread, -1),
            departures=torch.stack(bent, 1) if a.aspheres else None,
            stop=a.stop_place + 1,
        )

    def _departures(self, numbers: LensNumbers, surface: int, height: Tensor) -> Tensor:
        """Return a surface's departures from its vertex spheres, (n, zones)."""
        if not self.arrangement.is_asphere(surface):
            return torch.zeros((len(height), len(ZONES)), dtype=torch.float64)
        r = height[:, None] * torch.tensor(ZONES, dtype=torch.float64)
        curvature = numbers.curvatures[surface][:, None]
        sag = 0.5 * curvature * r.square()
        for order, number in enumerate(numbers.coefficients[surface], 2):
            sag = sag + number[:, None] * r ** (2 * order)
        return departures(sag, curvature.expand_as(r), r)


def element_powers(arrangement: Arrangement, values: Tensor, merit: SearchMerit) -> Tensor:
    """Return the thin powers of the elements, times the focal length, (n, elements)."""
    s = arrangement.surfaces
    curvatures, indices = values[:, :s], merit.first_order(values)[0].indices
    powers = []
    for surface, medium in enumerate(arrangement.media_behind):
        if medium >= 0:
            bend = curvatures[:, surface] - curvatures[:, surface + 1]
            powers.append((indices[surface + 1] - 1.0) * bend)
    return torch.stack(powers, -1)
