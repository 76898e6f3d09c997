"""Designs are many lenses of one arrangement; the best of them become lenses of their own."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, STOP, Arrangement, asphere
from dolens.lens_search.form_coordinates import ZONES, FormArrays, departures, form_coordinates
from dolens.lens_search.forms import TOLERANCE, form_numbers
from dolens.lens_search.glass.glass_merit import with_glasses_of
from dolens.lens_search.growth import Grown
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.paraxial import LensNumbers
from dolens.lens_search.real_pupils import stop_radii, with_real_beams
from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens
from dolens.prescriptions.build import lens_from_prescription


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

    @staticmethod
    def of(
        arrangement: Arrangement,
        grown: Grown,
        starts: Tensor,
        history: Sequence[tuple[str, ...]],
    ) -> "Designs":
        """Return lenses that have grown as designs, with the numbers of their starts (n,)."""
        return Designs(
            arrangement, grown.values, grown.spots, grown.violation, starts, tuple(history)
        )

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


Pool = dict[Arrangement, Designs]


def best_forms(pool: Pool, count: int) -> list[Designs]:
    """Return that many of the best forms of all arrangements, one each."""
    ranked = list(_ranked(pool))[:count]
    return [pool[arrangement].chosen(torch.tensor([row])) for arrangement, row in ranked]


def parents_of(pool: Pool, count: int, tried: dict[Arrangement, Tensor]) -> list[Designs]:
    """Return the best forms of all arrangements that have not been parents yet, and note them.

    Args:
        pool: all forms.
        count: of parents.
        tried: u of those that have been parents.
    """
    rows: dict[Arrangement, list[int]] = {}
    left = count
    for arrangement, row in _ranked(pool):
        if arrangement.within:  # elements around a stop in glass cannot be taken apart
            continue
        values = pool[arrangement].values[row]
        before = tried.get(arrangement)
        if before is not None and bool((before - values).abs().amax(-1).lt(1e-3).any()):
            continue
        rows.setdefault(arrangement, []).append(row)
        left -= 1
        if left == 0:
            break
    found = []
    for arrangement, chosen in rows.items():
        designs = pool[arrangement].chosen(torch.tensor(chosen))
        before = tried.get(arrangement)
        tried[arrangement] = (
            designs.values if before is None else torch.cat([before, designs.values])
        )
        found.append(designs)
    return found


def shares(designs: Designs, size: int = 4) -> Sequence[Designs]:
    """Return designs in parts, a task each."""
    rows = torch.arange(len(designs.values))
    return [designs.chosen(part) for part in rows.split(size)]


def _ranked(pool: Pool) -> Iterator[tuple[Arrangement, int]]:
    """Yield the arrangement and the row of each form, the best first."""
    ranked = sorted(
        (float(merit), arrangement.stop, arrangement.within, row, arrangement)
        for arrangement, designs in pool.items()
        for row, merit in enumerate(designs.merit)
    )
    for *_, row, arrangement in ranked:
        yield arrangement, row


# Edges of elements over the height of the beam.  A polynomial may turn steeply where no ray passes,
# and where light may be vignetted the edges are what clips it.
_MARGIN, _TIGHT = 1.05, 1.005


def designed_lens(
    arrangement: Arrangement, specification: Specification, values: Tensor, name: str
) -> Lens:
    """Return a design as a lens with a stop that limits the beam, fields and wavelengths.

    The stop's semi-diameter is that of the axial beam at the reference wavelength, by a real ray.
    Other apertures pass the whole beam with some room.

    Args:
        arrangement: the order of its elements.
        specification: what it is for.
        values: u, (P,).
        name: of the lens.
    """
    specification = with_glasses_of(arrangement, specification, values)
    values = values[: arrangement.variables]
    f = specification.focal_length
    merit = SearchMerit.of(arrangement, specification, 1, 1)
    numbers, found = merit.first_order(values[None])
    radius = 0.5 * f / specification.f_number
    field = max(float(t) for t in merit.rays.tangent) * f
    zero = torch.zeros(1, dtype=torch.float64)
    conditions = with_real_beams(merit, values[None], merit.full(1))
    stop_radius = float(stop_radii(merit, values[None], conditions)) * f
    surfaces: dict[str, dict[str, Any]] = {}
    gaps = [*(float(gap) * f for gap in numbers.gaps), None]
    media = [*arrangement.gap_media, AIR]
    for place, number in enumerate(arrangement.sequence):
        row: dict[str, Any] = {"type": "aperture"}
        if number == STOP:
            row["semi_diameter"] = stop_radius
        else:
            curvature = float(numbers.curvatures[number]) / f
            height = abs(float(found.marginal[number] + zero)) * radius
            height += abs(float(found.chief[number] + zero)) * field
            height *= float(conditions.beam[0, number])
            row, margin = {"type": "plane"}, _TIGHT if specification.vignetting else _MARGIN
            if arrangement.is_asphere(number):
                margin = _TIGHT
                terms = enumerate(numbers.coefficients[number])
                row = asphere(
                    curvature or 1e-12 / f, [float(a) / f ** (2 * n + 3) for n, a in terms]
                )
            elif curvature != 0.0:
                row = {"type": "sphere", "radius": 1.0 / curvature}
                height = min(height, 0.99 / abs(curvature) / margin)
            row["semi_diameter"] = margin * height
        if gaps[place] is not None:
            row["thickness"] = gaps[place]
        medium = media[place]
        row["material"] = "air" if medium == AIR else specification.element_glasses[medium]
        surfaces[str(place + 1)] = row
    image = float(numbers.image) * f
    return lens_from_prescription(
        {
            "name": name,
            "stop": arrangement.stop_place + 1,
            "wavelengths": list(specification.wavelengths),
            "reference_wavelength": specification.wavelengths[specification.reference],
            "fields": {"angles": [[0.0, float(angle)] for angle in specification.fields]},
            "surfaces": surfaces,
            "sensor": {"distance": image, "diameter": 2.2 * field},
        },
        dtype=torch.float64,
        where=name,
    )
