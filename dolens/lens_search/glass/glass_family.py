"""Lenses of one structure are traced each with glasses of its own.

The variables of such a lens are those of its family, then C coordinates of the glass of each
element, and then the number of each glass: that of a catalogue glass of a set, or `FREE` or `HELD`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from dolens.kernels.table import MapOfLenses, VariableMap
from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.glass.choice import GlassSet
from dolens.optics.lens_family import FamilyJacobian, FamilyRays, FamilySums, LensFamily
from dolens.optics.rays import TracedRays

# Numbers of glasses that are no catalogue's: the coordinates vary, or stay as they are.
FREE, HELD = -1, -2


@dataclass(frozen=True)
class FamilyOfGlasses:
    """Traces lenses as a `LensFamily` does, each with its own indices.

    Args:
        family: of the lenses without their glasses.
        arrangement: says which gap is of which element.
        glasses: those that have numbers.
        free: whether there are derivatives with respect to coordinates; without, they are zero.
    """

    family: LensFamily
    arrangement: Arrangement
    glasses: GlassSet
    free: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of elements and that of the coordinates of a glass."""
        return sum(self.arrangement.groups), self.glasses.coordinates.shape[1]

    def parts(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what is in front of the glasses, their coordinates (L, G, C) and numbers (L, G).

        Args:
            values: (L, ... + G C + G).
        """
        elements, count = self.shape
        end = values.shape[1] - elements
        first = end - elements * count
        coordinates = values[:, first:end].unflatten(1, self.shape)
        return values[:, :first], coordinates, values[:, end:].round().long()

    def glass_indices(self, values: Tensor) -> Tensor:
        """Return the indices of the glasses, (L, G, W)."""
        _, coordinates, numbers = self.parts(values)
        return self.glasses.index(coordinates, numbers)

    @cached_property
    def _glass_gaps(self) -> tuple[Tensor, Tensor]:
        """Return the rows of the indices that are glass, and the element of each.

        Row 0 is in front of the pupil's plane, row 1 behind it.
        """
        media = self.arrangement.gap_media
        rows = [row for row, m in enumerate(media, 2) if m != AIR]
        return torch.tensor(rows), torch.tensor([m for m in media if m != AIR])

    @cached_property
    def _air(self) -> Tensor:
        """Return the indices of the family's own lens, (1, media, W)."""
        return self.family.table(self.family.start[None]).indices

    @cached_property
    def _map(self) -> VariableMap | None:
        """Return the map of the variables in front of the numbers."""
        if not self.free:
            return None
        elements, count = self.shape
        rows, media = self._glass_gaps
        first = self.family.count
        columns = first + (media[:, None] * count + torch.arange(count)).flatten()
        return self.family.with_indices(
            rows.repeat_interleave(count), columns, first + elements * count
        )

    def _given(self, values: Tensor) -> tuple[Tensor, Tensor, MapOfLenses | None]:
        """Return the family's values, the indices (L, media, W), and the map with indices."""
        own, coordinates, numbers = self.parts(values)
        rows, media = self._glass_gaps
        indices = self._air.repeat(len(values), 1, 1)
        indices[:, rows] = self.glasses.index(coordinates, numbers)[:, media]
        if self._map is None:
            return own, indices, None
        slopes = self.glasses.basis.slopes.repeat(len(media), 1)
        slopes = slopes.expand(len(values), -1, -1).contiguous()
        return own, indices, MapOfLenses(self._map, index_derivatives=slopes)

    @property
    def _without(self) -> int:
        """Return how many of the last variables have no derivatives."""
        elements, count = self.shape
        return elements if self.free else elements * (count + 1)

    def normal_equations(
        self,
        values: Tensor,
        rays: FamilyRays,
        target: Tensor,
        weight: Tensor,
        group: Tensor,
        groups: int,
    ) -> FamilySums:
        """Return sums as `LensFamily.normal_equations` does, for all variables."""
        own, indices, variables = self._given(values)
        found = self.family.normal_equations(
            own, rays, target, weight, group, groups, indices=indices, variables=variables
        )
        more = self._without
        return replace(
            found,
            jtr=pad(found.jtr, (0, more)),
            jtj=pad(found.jtj, (0, more, 0, more)),
            group_jacobian=pad(found.group_jacobian, (0, more)),
        )

    def jacobians(self, values: Tensor, rays: FamilyRays, outputs: Sequence[str]) -> FamilyJacobian:
        """Return derivatives as `LensFamily.jacobians` does, with respect to all variables."""
        own, indices, variables = self._given(values)
        found = self.family.jacobians(own, rays, outputs, indices, variables)
        return replace(found, derivatives=pad(found.derivatives, (0, 0, 0, self._without)))

    def trace(self, values: Tensor, rays: FamilyRays) -> TracedRays:
        """Return the rays on the sensors."""
        own, indices, _ = self._given(values)
        return self.family.trace(own, rays, indices)

    def intercepts(self, values: Tensor, rays: FamilyRays, surface: int) -> tuple[Tensor, Tensor]:
        """Return x and y of rays on a surface, as `LensFamily.intercepts` does."""
        own, indices, _ = self._given(values)
        return self.family.intercepts(own, rays, surface, indices)
