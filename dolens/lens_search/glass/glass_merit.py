"""The merit of a search whose lenses have glasses of their own.

Variables are those of the lens, as `SearchMerit` has them, then C coordinates of the glass of each
element, and then its number: of a catalogue glass, whose exact indices count, or `FREE` for one
that varies, or `HELD` for one that stays where it is.  So a design carries its glasses with it.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.glass.choice import GlassSet, chosen_glasses
from dolens.lens_search.glass.dispersion_coordinates import GlassRegion, material_text
from dolens.lens_search.glass.glass_family import FREE, HELD, FamilyOfGlasses
from dolens.lens_search.glass.thin_achromats import drawn_glasses
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.paraxial import LensNumbers, Paraxial, Tangents, numbers_of, paraxial
from dolens.lens_search.search_rays import Conditions, search_rays
from dolens.lens_search.specification import Specification
from dolens.optimize.batch_least_squares import BatchModel

# Of the distance beyond a wall of the region of existing glasses, in the coordinates' units, beside
# an RMS spot over the focal length.  A triplet's glasses end 0.01 to 0.03 beyond, less than it is
# from one real glass to the next; steeper walls stop the descent where they begin.
WALL_WEIGHT = 3e-4
# Continuous glasses may leave the box about the real ones by so much; walls hold them nearer.
_BEYOND = 0.5


@dataclass(frozen=True)
class GlassMerit(SearchMerit):
    """Evaluates lenses of one arrangement, each with glasses of its own.

    Args:
        glasses: the real ones.
        wall_weight: of the distance that a continuous glass is beyond the region of these.
        free: whether glasses may vary; where none does, derivatives are found faster without them.

    Raises:
        InputError: the glasses have other wavelengths.
    """

    glasses: GlassSet = field(kw_only=True)
    wall_weight: float = WALL_WEIGHT
    free: bool = True

    def __post_init__(self) -> None:
        wanted = tuple(self.specification.wavelengths)
        if self.glasses.basis.wavelengths != wanted:
            raise InputError(
                f"glasses have indices at {list(self.glasses.basis.wavelengths)} nm, the search "
                f"needs them at {list(wanted)} nm"
            )

    @cached_property
    def _bare(self) -> SearchMerit:
        """Return the merit of lenses of any glasses, for what does not depend on them."""
        # A surface between equal media would bend nothing in any lens of the family.
        glasses = tuple(f"{1.5 + 0.01 * n:.2f}" for n in range(self.specification.elements))
        plain = replace(self.specification, glasses=glasses, glass_choice=None)
        return SearchMerit(self.arrangement, plain, self.rays, self.operand_weight)

    @cached_property
    def family(self) -> FamilyOfGlasses:  # type: ignore[override]
        """Return what the lenses share."""
        return FamilyOfGlasses(self._bare.family, self.arrangement, self.glasses, self.free)

    @cached_property
    def is_limit(self) -> Tensor:
        """Return which operands are limits, (O,), bool."""
        return self._bare.is_limit

    @cached_property
    def scales(self) -> Tensor:
        """Return what variables are multiplied by to be those of the family; 1 for glasses."""
        elements, count = self.shape
        ones = torch.ones(elements * (count + 1), dtype=torch.float64)
        return torch.cat([self._bare.scales, ones])

    @cached_property
    def region(self) -> GlassRegion:
        """Return the region of existing glasses."""
        return self.glasses.region()

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of elements and that of the coordinates of a glass."""
        return self.family.shape

    # ---------------------------------------------------------------- glasses of lenses

    def coordinates(self, u: Tensor) -> Tensor:
        """Return the coordinates (L, G, C) of the glasses of lenses u."""
        return self.family.parts(u)[1]

    def numbers(self, u: Tensor) -> Tensor:
        """Return the numbers (L, G) of the glasses of lenses u, int64."""
        return self.family.parts(u)[2]

    def with_glasses(self, lenses: Tensor, coordinates: Tensor, numbers: Tensor) -> Tensor:
        """Return u of lenses (L, P or more) with glasses at (L, G, C), numbers (L, G)."""
        own = lenses[:, : self.arrangement.variables]
        return torch.cat([own, coordinates.flatten(1), numbers.to(own)], 1)

    def held(self) -> "GlassMerit":
        """Return the merit of lenses whose glasses all stay as they are."""
        return replace(self, free=False)

    def freed(self, u: Tensor) -> Tensor:
        """Return the lenses with glasses that vary."""
        return self.with_glasses(u, self.coordinates(u), torch.full_like(self.numbers(u), FREE))

    def names(self, u: Tensor) -> list[tuple[str, ...]]:
        """Return the names of the glasses of each lens; nothing for one of no catalogue."""
        known = self.glasses.names
        return [tuple(known[n] if n >= 0 else "" for n in row) for row in self.numbers(u).tolist()]

    def materials(self, u: Tensor) -> tuple[str, ...]:
        """Return the glasses of one lens u, (1, N), as a prescription writes them."""
        points = self.coordinates(u)[0].tolist()
        pairs = zip(self.names(u)[0], points, strict=True)
        return tuple(name or material_text(point) for name, point in pairs)

    def are_real(self, u: Tensor) -> Tensor:
        """Return which lenses have catalogue glasses alone, (L,)."""
        return (self.numbers(u) >= 0).all(1)

    def cost_factor(self, u: Tensor) -> Tensor:
        """Return what the merit of lenses is multiplied by for what their glasses cost, (L,)."""
        choice, numbers = self.specification.glass_choice, self.numbers(u)
        if choice is None or not choice.costs:
            return torch.ones(len(u), dtype=torch.float64)
        shares = self.glasses.costs(choice.costs)[numbers.clamp(min=0)]
        return 1.0 + torch.where(numbers >= 0, shares, 0.0).sum(1)

    def kinds(self, u: Tensor) -> Tensor:
        """Return a number of the glasses of each lens, (L,): the same for the same glasses."""
        return torch.unique(self.numbers(u), dim=0, return_inverse=True)[1]

    def completed(self, lenses: Tensor, generator: torch.Generator) -> Tensor:
        """Return lenses (L, P) with glasses: those of the specification, or drawn ones."""
        given = self.specification.element_glasses
        if given:
            points = self.glasses.points_of(given).expand(len(lenses), -1, -1)
            numbers = torch.full(points.shape[:2], FREE if self.free else HELD)
            return self.with_glasses(lenses, points, numbers)
        s = self.arrangement.surfaces
        numbers, curvatures = drawn_glasses(
            self.glasses, self.arrangement.groups, lenses[:, :s], generator
        )
        lenses = torch.cat([curvatures, lenses[:, s:]], 1)
        u = self.with_glasses(lenses, self.glasses.coordinates[numbers], numbers)
        return self.freed(u) if self.free else u

    def box(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the boxes of lenses, (L, N) each; glasses that do not vary have one point."""
        lower, upper = self.bounds()
        points, numbers = self.coordinates(u), self.numbers(u)
        held = (numbers != FREE)[..., None]
        known = self.glasses.coordinates
        ends = []
        for bound, edge in ((lower, known.amin(0) - _BEYOND), (upper, known.amax(0) + _BEYOND)):
            own = bound.expand(len(u), -1)
            ends.append(self.with_glasses(own, torch.where(held, points, edge), numbers))
        return ends[0], ends[1]

    def colour(self, u: Tensor) -> Tensor:
        """Return how much nearer to the lens the focus of the shortest wavelength is than that of
        the longest, over f, (L,).
        """
        waves = self.specification.wavelengths
        blue, red = (
            paraxial(self.arrangement, self.numbers_at(u, waves.index(edge(waves)))).back_focus
            for edge in (min, max)
        )
        return red - blue

    def dispersions(self, u: Tensor) -> Tensor:
        """Return how much the indices behind surfaces fall from the shortest wavelength to the
        longest, (L, S + 1).
        """
        waves = self.specification.wavelengths
        short, long = (waves.index(edge(waves)) for edge in (min, max))
        blue, red = (torch.stack(list(self.numbers_at(u, n).indices)) for n in (short, long))
        return (blue - red).T

    # ---------------------------------------------------------------- values

    def lens_values(self, u: Tensor, pupil: Tensor) -> Tensor:
        """Return the family's variables, mm, with the glasses behind them."""
        own = super().lens_values(u, pupil)
        return torch.cat([own, u[:, self.arrangement.variables :]], 1)

    def lens_numbers(self, u: Tensor) -> LensNumbers:
        """Return the numbers of lenses u, with derivatives with respect to u."""
        glasses, slopes = self._reference_indices(u), self.glasses.basis.slopes
        slopes = slopes[:, self.specification.reference] * float(self.free)
        carried = []
        for glass, index in enumerate(glasses.T):
            rows = u.new_zeros(1 + u.shape[1], len(u))
            rows[0] = index
            first = 1 + self.arrangement.variables + glass * len(slopes)
            rows[first : first + len(slopes)] = slopes[:, None]
            carried.append(Tangents(rows))
        behind = (AIR, *self.arrangement.media_behind)
        indices = [
            carried[m] if m != AIR else air
            for m, air in zip(behind, self._bare.indices, strict=True)
        ]
        return numbers_of(self.arrangement, Tangents.variables(u), indices)

    def first_order(self, u: Tensor) -> tuple[LensNumbers, Paraxial]:
        """Return the numbers of lenses u, times or over f, and what follows for paraxial rays."""
        numbers = self.numbers_at(u, self.specification.reference)
        return numbers, paraxial(self.arrangement, numbers)

    def numbers_at(self, u: Tensor, wavelength: int) -> LensNumbers:
        """Return the numbers of lenses u with their indices at one of the wavelengths."""
        own = self.family.glass_indices(u)[..., wavelength]
        media = (AIR, *self.arrangement.media_behind)
        air = self._bare.indices
        # Air is air at every wavelength: indices are relative to it.
        indices = [
            own[:, m] if m != AIR else air[row].expand(len(u)) for row, m in enumerate(media)
        ]
        return numbers_of(self.arrangement, u.unbind(-1), indices)

    def _reference_indices(self, u: Tensor) -> Tensor:
        return self.family.glass_indices(u)[..., self.specification.reference]

    def evaluate(self, u: Tensor, conditions: Conditions) -> BatchModel:
        """Return the models of lenses with the walls of the region about glasses that vary."""
        return self.walled(u, super().evaluate(u, conditions))

    def optical(self, u: Tensor, conditions: Conditions) -> BatchModel:
        """Return the models of lenses without walls."""
        return super().evaluate(u, conditions)

    def walled(self, u: Tensor, model: BatchModel) -> BatchModel:
        """Return models with the walls of the region about glasses that vary."""
        if not self.free:
            return model
        varies = self.wall_weight * (self.numbers(u) == FREE)
        hinges, slopes = self.region.hinges(self.coordinates(u))
        hinges, slopes = hinges * varies[..., None], slopes * varies[..., None, None]
        first, count = self.arrangement.variables, self.shape[1]
        gradient, hessian = model.gradient.clone(), model.hessian.clone()
        pull = torch.einsum("lgf,lgfc->lgc", hinges, slopes).flatten(1)
        gradient[:, first : first + pull.shape[1]] += pull
        for glass, block in enumerate(torch.einsum("lgfc,lgfd->glcd", slopes, slopes)):
            here = slice(first + glass * count, first + (glass + 1) * count)
            hessian[:, here, here] += block
        return BatchModel(model.merit + hinges.square().sum((1, 2)), gradient, hessian)


def merit_of(
    arrangement: Arrangement,
    specification: Specification,
    rings: int = 4,
    arms: int = 8,
    free: bool = True,
) -> SearchMerit:
    """Return the merit with rays of that many rings and arms.

    Args:
        arrangement: the order of elements.
        specification: with a choice of glasses, lenses have glasses of their own.
        rings: of the pupil.
        arms: of its half.
        free: whether chosen glasses may vary.

    Raises:
        InputError: no glass is left to choose.
    """
    if specification.glass_choice is None:
        return SearchMerit.of(arrangement, specification, rings, arms)
    glasses = chosen_glasses(specification.glass_choice, tuple(specification.wavelengths))
    rays = search_rays(specification, rings, arms)
    return GlassMerit(arrangement, specification, rays, glasses=glasses, free=free)


def with_glasses_of(
    arrangement: Arrangement, specification: Specification, values: Tensor
) -> Specification:
    """Return the specification with the glasses of one design u, (N,), and nothing to choose."""
    merit = merit_of(arrangement, specification, 1, 1)
    if not isinstance(merit, GlassMerit):
        return specification
    return replace(specification, glasses=merit.materials(values[None]), glass_choice=None)
