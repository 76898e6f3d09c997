"""The merit of a search with glasses among the variables.

Variables are those of the lens, as `SearchMerit` has them, and then C coordinates of the glass of
each element.  Some glasses of a lens may be real ones: their indices are those of the catalogue.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.variable_map import VariableMap
from dolens.lens_search.arrangement import AIR
from dolens.lens_search.glass.glass_set import GlassSet
from dolens.lens_search.glass.region import GlassRegion
from dolens.lens_search.merit import Conditions, SearchMerit
from dolens.lens_search.paraxial import LensNumbers, numbers_of
from dolens.lens_search.tangents import Tangents
from dolens.optics.lens_family import FamilyJacobian, FamilyRays, FamilySums, LensFamily
from dolens.optics.rays import TracedRays
from dolens.optimize.batch_least_squares import BatchModel

# Of the distance beyond a wall of the region of existing glasses, in the coordinates' units, beside
# an RMS spot over the focal length.  A triplet's glasses end 0.01 to 0.03 beyond, less than it is
# from one real glass to the next; steeper walls stop the descent where they begin.
WALL_WEIGHT = 3e-4


@dataclass(frozen=True)
class GlassMerit:
    """Evaluates lenses of one arrangement, each with glasses of its own.

    Args:
        base: the merit of the lens; its specification's wavelengths are those of the glasses.
        glasses: the real ones.
        wall_weight: of the distance that a continuous glass is beyond the region of these.

    Raises:
        InputError: the glasses have other wavelengths.
    """

    base: SearchMerit
    glasses: GlassSet
    wall_weight: float = WALL_WEIGHT

    def __post_init__(self) -> None:
        wanted = tuple(self.base.specification.wavelengths)
        if self.glasses.basis.wavelengths != wanted:
            raise InputError(
                f"glasses have indices at {list(self.glasses.basis.wavelengths)} nm, the search "
                f"needs them at {list(wanted)} nm"
            )

    @cached_property
    def region(self) -> GlassRegion:
        """Return the region of existing glasses."""
        return self.glasses.region()

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of elements and that of the coordinates of a glass."""
        return sum(self.base.arrangement.groups), self.glasses.coordinates.shape[1]

    def coordinates(self, u: Tensor) -> Tensor:
        """Return the coordinates (L, G, C) among variables u (L, P + G C)."""
        return u[:, self.base.arrangement.variables :].unflatten(1, self.shape)

    def evaluate(self, u: Tensor, numbers: Tensor, conditions: Conditions) -> BatchModel:
        """Return the models of lenses, with the walls of the region.

        Args:
            u: (L, P + G C).
            numbers: (L, G), of the real glass of each element; -1 where it is continuous.
            conditions: of the lenses.
        """
        model = self.optical(u, numbers, conditions)
        hinges, slopes = self.region.hinges(self.coordinates(u))
        hinges = hinges * (self.wall_weight * (numbers < 0)[..., None])
        slopes = slopes * (self.wall_weight * (numbers < 0)[..., None, None])
        first = self.base.arrangement.variables
        gradient, hessian = model.gradient.clone(), model.hessian.clone()
        gradient[:, first:] += torch.einsum("lgf,lgfc->lgc", hinges, slopes).flatten(1)
        count = self.shape[1]
        for glass, block in enumerate(torch.einsum("lgfc,lgfd->glcd", slopes, slopes)):
            here = slice(first + glass * count, first + (glass + 1) * count)
            hessian[:, here, here] += block
        return BatchModel(model.merit + hinges.square().sum((1, 2)), gradient, hessian)

    def optical(self, u: Tensor, numbers: Tensor, conditions: Conditions) -> BatchModel:
        """Return the models of lenses without walls, with columns of real glasses, too."""
        return self._with_glasses(u, numbers).evaluate(u, conditions)

    def spots(self, u: Tensor, numbers: Tensor, conditions: Conditions) -> Tensor:
        """Return the RMS spot radii (L, F), mm; infinite where a ray fails."""
        return self._with_glasses(u, numbers).spots(u, conditions)

    def _with_glasses(self, u: Tensor, numbers: Tensor) -> "_LensesOfGlasses":
        base, family = self.base, self.base.family
        arrangement, (elements, count) = base.arrangement, self.shape
        n = self.glasses.index(self.coordinates(u), numbers)
        slopes = self.glasses.basis.slopes
        # Row 0 is in front of the pupil's plane, row 1 behind it.
        rows = torch.tensor([row for row, m in enumerate(arrangement.gap_media, 2) if m != AIR])
        media = torch.tensor([m for m in arrangement.gap_media if m != AIR])
        indices = family.table(family.start[None]).indices.repeat(len(u), 1, 1)
        indices[:, rows] = n[:, media]
        columns = family.count + (media[:, None] * count + torch.arange(count)).flatten()
        variables = family.with_indices(
            rows.repeat_interleave(count), columns, family.count + elements * count
        )
        by_index = slopes.repeat(len(media), 1)
        here = _LensesOfGlasses(
            base.arrangement,
            base.specification,
            base.rays,
            base.operand_weight,
            n[..., base.specification.reference],
            slopes[:, base.specification.reference],
        )
        traced = _FamilyOfGlasses(
            family, indices, variables, by_index.expand(len(u), -1, -1).contiguous()
        )
        behind = [
            n[:, m, base.specification.reference] if m != AIR else air.expand(len(u))
            for m, air in zip((AIR, *arrangement.media_behind), base.indices, strict=True)
        ]
        ones = torch.ones(elements * count, dtype=torch.float64)
        here.__dict__.update(
            family=traced,
            is_limit=base.is_limit,
            indices=torch.stack(behind),
            scales=torch.cat([base.scales, ones]),
        )
        return here


@dataclass(frozen=True)
class _FamilyOfGlasses:
    """Traces lenses each with its own indices."""

    family: LensFamily
    indices: Tensor
    variables: VariableMap
    index_derivatives: Tensor

    def normal_equations(
        self,
        values: Tensor,
        rays: FamilyRays,
        target: Tensor,
        weight: Tensor,
        group: Tensor,
        groups: int,
    ) -> FamilySums:
        return self.family.normal_equations(
            values,
            rays,
            target,
            weight,
            group,
            groups,
            indices=self.indices,
            variables=self.variables,
            index_derivatives=self.index_derivatives,
        )

    def jacobians(self, values: Tensor, rays: FamilyRays, outputs: Sequence[str]) -> FamilyJacobian:
        return self.family.jacobians(
            values, rays, outputs, self.indices, self.variables, self.index_derivatives
        )

    def trace(self, values: Tensor, rays: FamilyRays) -> TracedRays:
        return self.family.trace(values, rays, self.indices)


@dataclass(frozen=True)
class _LensesOfGlasses(SearchMerit):
    """Evaluates lenses whose glasses are known: G of each at the reference wavelength.

    Args:
        glass_indices: (L, G).
        glass_slopes: (C,), their derivatives with respect to their own coordinates.
    """

    glass_indices: Tensor | None = None
    glass_slopes: Tensor | None = None

    def lens_values(self, u: Tensor, pupil: Tensor) -> Tensor:
        return super().lens_values(u[:, : self.arrangement.variables], pupil)

    def lens_numbers(self, u: Tensor) -> LensNumbers:
        assert self.glass_indices is not None and self.glass_slopes is not None
        glasses = []
        for glass, index in enumerate(self.glass_indices.T):
            rows = u.new_zeros(1 + u.shape[1], len(u))
            rows[0] = index
            first = 1 + self.arrangement.variables + glass * len(self.glass_slopes)
            rows[first : first + len(self.glass_slopes)] = self.glass_slopes[:, None]
            glasses.append(Tangents(rows))
        behind = (AIR, *self.arrangement.media_behind)
        indices = [glasses[m] if m != AIR else self.indices[row] for row, m in enumerate(behind)]
        return numbers_of(self.arrangement, Tangents.variables(u), indices)
