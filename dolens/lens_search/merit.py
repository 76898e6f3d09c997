"""The merit of many lenses: RMS spots about their centroids, and operands for the specification.

Variables u are curvatures times the focal length f, gaps and the sensor's distance over f, and the
coefficients of aspheres likewise in units of f.  The merit is Σ_fields ω·(RMS spot/f)² +
Σ (weight·deviation)².
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement, parameter_names, template, variable_bounds
from dolens.lens_search.operands import chief_ray_angles, distortion, paraxial_operands
from dolens.lens_search.paraxial import LensNumbers, Paraxial, Tangents, numbers_of, paraxial
from dolens.lens_search.search_rays import (
    Conditions,
    SearchRays,
    launched,
    paraxial_pupils,
    search_rays,
)
from dolens.lens_search.specification import Specification
from dolens.optics.lens_family import FamilyRays, FamilySums, LensFamily
from dolens.optimize.batch_least_squares import BatchModel

# Of a relative deviation, beside an RMS spot over the focal length.  A step along a constraint's
# curved surface leaves it by the step's square: weights near one leave steps no room.
OPERAND_WEIGHT = 0.03


@dataclass(frozen=True)
class SearchMerit:
    """Evaluates lenses of one arrangement.

    Args:
        arrangement: the order of elements.
        specification: what they must do.
        rays: that sample them; None: `search_rays` with its own numbers.
        operand_weight: of deviations, relative or over the focal length.
    """

    arrangement: Arrangement
    specification: Specification
    rays: SearchRays
    operand_weight: float = OPERAND_WEIGHT

    @staticmethod
    def of(
        arrangement: Arrangement, specification: Specification, rings: int = 4, arms: int = 8
    ) -> "SearchMerit":
        """Return the merit with rays of that many rings and arms."""
        return SearchMerit(arrangement, specification, search_rays(specification, rings, arms))

    def sampled(self, rings: int, arms: int) -> "SearchMerit":
        """Return the same with other rays."""
        return replace(self, rays=search_rays(self.specification, rings, arms))

    @cached_property
    def family(self) -> LensFamily:
        """Return what the lenses share."""
        return _family(self.arrangement, self.specification)

    @cached_property
    def indices(self) -> Tensor:
        """Return the indices in front of the lens and behind each refracting surface at the
        reference wavelength, (S + 1, 1).
        """
        of_glasses = self.family.table(self.family.start[None]).indices[0]
        column = of_glasses[:, self.specification.reference]
        # Rows: in front of the pupil's plane, behind it, and behind each of the sequence.
        behind = [place for place, n in enumerate(self.arrangement.sequence, 2) if n >= 0]
        return column[[0, *behind]][:, None]

    def full(self, lenses: int) -> Conditions:
        """Return the conditions of the specification, all fields alike, for so many lenses."""
        fields = self.rays.fields
        return Conditions(
            torch.full((lenses,), self.specification.f_number, dtype=torch.float64),
            torch.ones(lenses, dtype=torch.float64),
            torch.full((lenses, fields), 1.0 / fields, dtype=torch.float64),
            torch.zeros((lenses, self.operands), dtype=torch.float64),
            paraxial_pupils(self.specification, self.rays).expand(lenses, -1, -1),
            torch.ones((lenses, self.arrangement.surfaces + 1), dtype=torch.float64),
        )

    @cached_property
    def operands(self) -> int:
        """Return the number O of operands."""
        return len(self.is_limit)

    @cached_property
    def is_limit(self) -> Tensor:
        """Return which operands are limits, (O,), bool; the others are to be zero."""
        u = torch.ones((1, self.arrangement.variables), dtype=torch.float64)
        one = torch.ones(1, dtype=torch.float64)
        beam = torch.ones((1, self.arrangement.surfaces + 1), dtype=torch.float64)
        _, _, limits = self._paraxial_operands(u, one, one, beam)
        held = self.specification.limits
        real = (held.distortion, held.chief_ray_angle).count(None)
        return torch.tensor([*limits, *([True] * ((2 - real) * self.rays.chiefs))])

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the box of the variables u, (P,) each."""
        return variable_bounds(self.arrangement, self.specification)

    def box(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the boxes of lenses u, (P,) or (L, P) each: the same for all here."""
        return self.bounds()

    # ---------------------------------------------------------------- glasses

    def completed(self, lenses: Tensor, generator: torch.Generator) -> Tensor:
        """Return lenses (L, P) with the glasses that starts have: here those of the specification,
        which are no variables.
        """
        return lenses

    def are_real(self, u: Tensor) -> Tensor:
        """Return which lenses have glasses that exist, (L,)."""
        return torch.ones(len(u), dtype=torch.bool)

    def cost_factor(self, u: Tensor) -> Tensor:
        """Return what the merit of lenses is multiplied by for what their glasses cost, (L,)."""
        return torch.ones(len(u), dtype=torch.float64)

    def kinds(self, u: Tensor) -> Tensor:
        """Return a number of the glasses of each lens, (L,): the same for the same glasses."""
        return torch.zeros(len(u), dtype=torch.int64)

    def colour(self, u: Tensor) -> Tensor:
        """Return how far apart the foci of the outer wavelengths are, over f, (L,), where starts
        are chosen by it: given glasses are for the descent to balance.
        """
        return torch.zeros(len(u), dtype=torch.float64)

    def dispersions(self, u: Tensor) -> Tensor | None:
        """Return how much the indices behind surfaces fall from the shortest wavelength to the
        longest, (L, S + 1); None where all lenses have the same glasses.
        """
        return None

    # ---------------------------------------------------------------- values

    def lens_values(self, u: Tensor, pupil: Tensor) -> Tensor:
        """Return the family's variables (L, P + 1), mm, of variables u (L, P).

        Args:
            u: of the lenses.
            pupil: from the first of the sequence to the entrance pupil over f, (L,).
        """
        f, s = self.specification.focal_length, self.arrangement.surfaces
        lens = u[:, : self.arrangement.variables] * self.scales[: self.arrangement.variables]
        return torch.cat([lens[:, :s], -pupil[:, None] * f, lens[:, s:]], 1)

    @cached_property
    def scales(self) -> Tensor:
        """Return what variables u are multiplied by to be those of the family, mm, (P,)."""
        powers = torch.tensor(self.arrangement.powers, dtype=torch.float64)
        return self.specification.focal_length**powers

    def lens_numbers(self, u: Tensor) -> LensNumbers:
        """Return the numbers of lenses u (L, P), with derivatives with respect to u."""
        return numbers_of(self.arrangement, Tangents.variables(u), list(self.indices))

    def first_order(self, u: Tensor) -> tuple[LensNumbers, Paraxial]:
        """Return the numbers of lenses u (L, P), times or over f, and what follows for paraxial
        rays.
        """
        numbers = numbers_of(self.arrangement, u.unbind(-1), list(self.indices))
        return numbers, paraxial(self.arrangement, numbers)

    def paraxial_of(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return power, entrance pupil and back focus of lenses u (L, P), times or over f."""
        _, found = self.first_order(u)
        pupil = found.entrance_pupil + torch.zeros_like(found.power)
        return found.power, pupil, found.back_focus

    def evaluate(self, u: Tensor, conditions: Conditions) -> BatchModel:
        """Return the models of lenses u (L, P), in units of f; no merit where a ray fails."""
        found = self._evaluate(u, conditions)
        f = self.specification.focal_length
        shifted = found.deviations + conditions.shifts
        shifted = torch.where(self.is_limit, shifted.clamp(min=0.0), shifted)
        # Where a target is met to the last digit, it still binds.
        binds = ~self.is_limit | (shifted > 0.0)
        rows = torch.where(binds[..., None], found.derivatives, 0.0)
        spots = self._in_variables(_about_centroids(found.sums), found.of_pupil)
        weight = self.operand_weight**2
        merit = spots.merit / f**2 + weight * shifted.square().sum(-1)
        return BatchModel(
            torch.where(found.usable, merit, torch.inf),
            spots.gradient / f**2 + weight * torch.einsum("lo,lop->lp", shifted, rows),
            spots.hessian / f**2 + weight * (rows.mT @ rows),
        )

    def deviations(self, u: Tensor, conditions: Conditions) -> Tensor:
        """Return the deviations of operands (L, O), relative or over f; see `is_limit`."""
        return self._evaluate(u, conditions).deviations

    def _evaluate(self, u: Tensor, conditions: Conditions) -> "_Evaluated":
        f = self.specification.focal_length
        first_order, of_first_order, _ = self._paraxial_operands(
            u,
            0.5 / conditions.f_number,
            conditions.field * self.rays.tangent.max(),
            conditions.beam,
        )
        pupil, of_pupil = first_order[:, 0], of_first_order[:, 0]
        rays, tangent = self._launched(conditions)
        by_group = torch.nn.functional.pad(
            conditions.field_weights, (0, self.rays.chiefs), value=1.0
        )
        sums = self.family.normal_equations(
            self.lens_values(u, pupil),
            rays,
            torch.stack([torch.zeros_like(tangent), f * tangent], -1),
            self.rays.weight * by_group[:, self.rays.group],
            self.rays.group,
            self.rays.groups,
        )
        deviations, rows = [first_order[:, 1:]], [of_first_order[:, 1:]]
        for deviation, row in self._of_chief_rays(u, pupil, rays, tangent, sums):
            deviations.append(deviation)
            rows.append(self._row_in_variables(row, of_pupil[:, None]))
        usable = (sums.count == tangent.shape[1]) & torch.isfinite(pupil)
        return _Evaluated(sums, torch.cat(deviations, 1), torch.cat(rows, 1), of_pupil, usable)

    def _of_chief_rays(
        self, u: Tensor, pupil: Tensor, rays: FamilyRays, tangent: Tensor, sums: FamilySums
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield deviations (L, C) of real chief rays, and their derivatives (L, C, P + 1) with
        respect to the family's variables.
        """
        chiefs, limits = self.rays.chiefs, self.specification.limits
        if limits.distortion is not None and chiefs:
            ideal = self.specification.focal_length * tangent[:, -chiefs:]
            waves = bool(self.arrangement.aspheres)
            yield distortion(sums, self.rays, ideal, limits.distortion, waves)
        if limits.chief_ray_angle is not None and chiefs:
            chief = FamilyRays(
                rays.position[:, -chiefs:],
                rays.direction[:, -chiefs:],
                self.rays.wavelength[-chiefs:],
            )
            values = self.lens_values(u, pupil)
            yield chief_ray_angles(self.family, values, chief, limits.chief_ray_angle)

    def spots(self, u: Tensor, conditions: Conditions) -> Tensor:
        """Return the RMS spot radii (L, F), mm, about centroids; infinite where a ray fails."""
        pupil = self.paraxial_of(u)[1]
        rays, tangent = self._launched(conditions)
        hit = self.family.trace(self.lens_values(u, pupil), rays)
        ideal = self.specification.focal_length * tangent
        found = []
        for field in range(self.rays.fields):
            mine = self.rays.group == field
            weight = self.rays.weight[mine]
            x, y = hit.position[:, mine, 0], hit.position[:, mine, 1] - ideal[:, mine]
            y = y - (weight * y).sum(-1, keepdim=True)
            square = (weight * (x * x + y * y)).sum(-1)
            passes = hit.valid[:, mine].all(-1)
            found.append(torch.where(passes, square.sqrt(), torch.inf))
        return torch.stack(found, -1)

    def _launched(self, conditions: Conditions) -> tuple[FamilyRays, Tensor]:
        """Return the rays of every lens, and the tangents of their field angles (L, N)."""
        radius = 0.5 * self.specification.focal_length / conditions.f_number
        position, direction, tangent = launched(
            self.rays, radius, conditions.field, conditions.pupils
        )
        return FamilyRays(position, direction, self.rays.wavelength), tangent

    def _paraxial_operands(
        self, u: Tensor, radius: Tensor, field: Tensor, beam: Tensor
    ) -> tuple[Tensor, Tensor, list[bool]]:
        """Return the entrance pupil's place and the paraxial operands (L, 1 + O), their derivatives
        (L, 1 + O, P), and which operands are limits.
        """
        numbers = self.lens_numbers(u)
        first_order = paraxial(self.arrangement, numbers)
        operands, limits = paraxial_operands(
            self.arrangement, self.specification, numbers, first_order, radius, field, beam
        )
        pupil = first_order.entrance_pupil
        if not isinstance(pupil, Tangents):  # the stop is the first of the sequence
            pupil = 0.0 * numbers.image
        rows = torch.cat([pupil.rows[None], operands.rows])
        return rows[:, 0].T, rows[:, 1:].permute(2, 0, 1), limits

    def _row_in_variables(self, row: Tensor, of_pupil: Tensor) -> Tensor:
        """Return derivatives (..., L, P) with respect to u from those (..., L, P + 1) with respect
        to the family's variables.
        """
        f, s = self.specification.focal_length, self.arrangement.surfaces
        own = torch.cat([row[..., :s], row[..., s + 1 :]], -1) * self.scales
        return own - f * row[..., s : s + 1] * of_pupil

    def _in_variables(self, model: BatchModel, of_pupil: Tensor) -> BatchModel:
        """Return the model in u of one in the family's variables, with the pupil's distance
        following from u.
        """
        first = self._row_in_variables(model.hessian, of_pupil[:, None])
        both = self._row_in_variables(first.mT, of_pupil[:, None])
        return BatchModel(model.merit, self._row_in_variables(model.gradient, of_pupil), both)


@dataclass(frozen=True)
class _Evaluated:
    """Holds what a model is made of."""

    sums: FamilySums
    deviations: Tensor
    derivatives: Tensor
    of_pupil: Tensor
    usable: Tensor


def _about_centroids(sums: FamilySums) -> BatchModel:
    """Return the sums about the centroids of spots, without the chief rays.

    x has no centroid: half of the pupil stands for the whole.  A chief ray is alone in its group,
    and is taken off with its centroid; in x it is zero.
    """
    residual, jacobian = sums.group_residual[..., 1], sums.group_jacobian[:, :, 1]
    inverse = 1.0 / sums.group_weight.clamp(min=1e-300)
    mean = residual * inverse
    scaled = jacobian * inverse.sqrt()[..., None]
    return BatchModel(
        sums.sum_of_squares - (residual * mean).sum(1),
        sums.jtr - torch.einsum("lg,lgp->lp", mean, jacobian),
        sums.jtj - torch.einsum("lgp,lgq->lpq", scaled, scaled),
    )


@lru_cache(maxsize=64)
def _family(arrangement: Arrangement, specification: Specification) -> LensFamily:
    """Return what lenses share: one for all merits of an arrangement."""
    lens = template(arrangement, specification, 2.0 * specification.focal_length)
    return LensFamily(lens, parameter_names(arrangement), specification.wavelengths)
