"""Lenses grow: aperture and field begin small and become those of the specification.

At each stage all lenses are optimised for some iterations, and the better part goes on (successive
halving).  At the end operands are made to hold exactly, by an augmented Lagrangian (Nocedal and
Wright, Numerical Optimization, ch. 17), and the fields are weighted so that the mean of their RMS
spots is least rather than its square.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.real_pupils import with_real_beams
from dolens.lens_search.search_rays import Conditions
from dolens.optimize.batch_least_squares import BatchModel, BatchResult, minimise_batch


@dataclass(frozen=True)
class Stage:
    """A stage of growth.

    Attributes:
        f_number: factor of the specification's.
        field: factor of the tangents of its field angles.
        iterations: of each lens, at most.
        kept: share of the lenses that go on.
        rings: of rays in the pupil.
        arms: azimuths of its half.
        tolerance: a lens that gains less of its merit, several times in a row, rests.

    Raises:
        InputError: a number out of range.
    """

    f_number: float = 1.0
    field: float = 1.0
    iterations: int = 60
    kept: float = 1.0
    rings: int = 3
    arms: int = 6
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if not self.f_number >= 1.0:
            raise InputError(f"stage: f_number must be 1 or more, not {self.f_number}")
        if not 0.0 < self.field <= 1.0:
            raise InputError(f"stage: field must lie above 0 and to 1, not {self.field}")
        if not 0.0 < self.kept <= 1.0:
            raise InputError(f"stage: kept must lie above 0 and to 1, not {self.kept}")
        if min(self.iterations, self.rings, self.arms) < 1:
            raise InputError("stage: iterations, rings and arms must be 1 or more")


# Of a wide aperture: its starts are grown in three stages.
STAGES = (
    Stage(8.0 / 3.0, 0.4, iterations=10),
    Stage(5.0 / 3.0, 0.7, iterations=20, kept=0.5),
    Stage(1.0, 1.0, iterations=60, kept=0.5),
)


# Lenses evaluated together: their arrays then stay in the processor's cache.
_AT_A_TIME = 1024
# Parts of the way to the next stage that are tried, and how often a lens goes a part of it.
_STEPS = (1.0, 0.5, 0.25, 0.125)
_TRIES = 4
# Of a finish, the last rounds have operands whose weight grows by a factor.
_FIRM_ROUNDS, _FIRMER = 2, 3.0


@dataclass(frozen=True)
class Grown:
    """Lenses at the end of their growth.

    Attributes:
        values: u, (n, P).
        starts: (n,), int64, numbers of the starts that they came from.
        spots: RMS spot radii, mm, (n, F).
        violation: (n,), by how much the worst operand fails, relative or over the focal length.
        iterations: of all lenses together.
    """

    values: Tensor
    starts: Tensor
    spots: Tensor
    violation: Tensor
    iterations: int

    @property
    def merit(self) -> Tensor:
        """Return the mean of the RMS spot radii over the fields, mm, (n,)."""
        return self.spots.mean(-1)

    def best(self, share: float) -> "Grown":
        """Return the better part of the lenses."""
        order = self.merit.argsort()[: max(1, round(share * len(self.values)))]
        values, starts = self.values[order], self.starts[order]
        return Grown(values, starts, self.spots[order], self.violation[order], self.iterations)


def grow(merit: SearchMerit, starts: Tensor, stages: Sequence[Stage] = STAGES) -> Grown:
    """Grow starts to the full aperture and field.

    Args:
        merit: of the lenses; stages sample them with rays of their own.
        starts: u, (n, P).
        stages: in their order.
    """
    values, numbers = starts, torch.arange(len(starts))
    iterations = 0
    before = stages[0]
    for stage in stages:
        found = _at_stage(merit, values, before, stage)
        before = stage
        iterations += int(found.iterations.sum())
        best = found.merit.argsort()[: max(1, round(stage.kept * len(values)))]
        best = best[torch.isfinite(found.merit[best])]
        values, numbers = found.values[best], numbers[best]
    return _described(merit, values, numbers, iterations)


def _at_stage(merit: SearchMerit, starts: Tensor, before: Stage, stage: Stage) -> BatchResult:
    """Return lenses optimised at a stage; those whose rays fail there go a part of the way first.

    Args:
        merit: of the lenses.
        starts: u, (n, P), optimised at the stage before.
        before: that stage.
        stage: the next one.
    """
    sampled = merit.sampled(stage.rings, stage.arms)
    values, count = starts.clone(), len(starts)
    reached = torch.zeros(count, dtype=torch.float64)
    merits = torch.full((count,), torch.inf, dtype=torch.float64)
    iterations = torch.zeros(count, dtype=torch.int64)
    ended = torch.zeros(count, dtype=torch.int8)
    going = torch.arange(count)
    for _ in range(_TRIES):
        reached[going] = _reachable(sampled, values[going], before, stage, reached[going])
        conditions = _between(sampled, before, stage, reached[going])
        found = _minimised(sampled, values[going], conditions, stage.iterations, stage.tolerance)
        values[going], ended[going] = found.values, found.ended
        iterations[going] += found.iterations
        there = reached[going] == 1.0
        merits[going] = torch.where(there, found.merit, torch.inf)
        going = going[~there & torch.isfinite(found.merit)]
        if not len(going):
            break
    return BatchResult(values, merits, iterations, ended)


def _reachable(
    merit: SearchMerit, values: Tensor, before: Stage, stage: Stage, reached: Tensor
) -> Tensor:
    """Return the share of the way from a stage to the next at which all rays of a lens pass, (n,):
    all of what is left, or a half, a quarter or an eighth of it; where not even that, `reached`.
    """
    found, left = reached.clone(), torch.arange(len(values))
    for step in _STEPS:
        share = reached[left] + step * (1.0 - reached[left])
        spots = merit.spots(values[left], _between(merit, before, stage, share))
        passes = torch.isfinite(spots).all(-1)
        found[left[passes]] = share[passes]
        left = left[~passes]
        if before == stage or not len(left):
            break
    return found


def _between(merit: SearchMerit, before: Stage, stage: Stage, share: Tensor) -> Conditions:
    """Return the conditions of n lenses, each a share of the way from one stage to the next."""
    full = merit.full(len(share))
    return replace(
        full,
        f_number=full.f_number * (before.f_number + share * (stage.f_number - before.f_number)),
        field=full.field * (before.field + share * (stage.field - before.field)),
    )


def finish(
    merit: SearchMerit, grown: Grown, rounds: int = 6, iterations: int = 40, tolerance: float = 1e-4
) -> Grown:
    """Optimise grown lenses to the end: operands hold, and the mean of the spots is least.

    Args:
        merit: with the rays that decide.
        grown: the lenses.
        rounds: times that the shifts of operands and the weights of fields are set anew.
        iterations: of each round and lens, at most.
        tolerance: as of a stage; the last round's is a hundredth of it.
    """
    done = settled(merit, grown.values, rounds, iterations, tolerance)
    used = grown.iterations + done.iterations
    return _described(done.merit, done.values, grown.starts, used, done.conditions)


@dataclass(frozen=True)
class Settled:
    """Lenses whose operands hold.

    Attributes:
        merit: with the operands' final weight.
        values: u, (n, P).
        conditions: with the final shifts, weights of fields and real beams.
        iterations: of all lenses together.
    """

    merit: SearchMerit
    values: Tensor
    conditions: Conditions
    iterations: int


def settled(
    merit: SearchMerit, values: Tensor, rounds: int, iterations: int, tolerance: float = 1e-4
) -> Settled:
    """Optimise lenses u (n, P) to the end, as `finish` does, and return the conditions, too."""
    used = 0
    conditions = with_real_beams(merit, values, merit.full(len(values)))
    for number in range(rounds):
        last = number == rounds - 1
        if number >= rounds - _FIRM_ROUNDS:
            # Multipliers are known by now: firmer operands leave the valley as it is.
            merit = replace(merit, operand_weight=_FIRMER * merit.operand_weight)
            conditions = replace(conditions, shifts=conditions.shifts / _FIRMER**2)
        found = _minimised(merit, values, conditions, iterations, tolerance * (0.01 if last else 1))
        used += int(found.iterations.sum())
        values = found.values
        conditions = _next_conditions(merit, values, conditions)
    return Settled(merit, values, conditions, used)


def _next_conditions(merit: SearchMerit, values: Tensor, conditions: Conditions) -> Conditions:
    """Return shifts by the deviations that were left, and weights by the spots."""
    shifted = conditions.shifts + merit.deviations(values, conditions)
    shifted = torch.where(merit.is_limit, shifted.clamp(min=0.0), shifted)
    spots = merit.spots(values, conditions)
    inverse = 1.0 / spots.clamp(min=1e-12)
    weights = inverse / inverse.sum(-1, keepdim=True)
    fine = torch.isfinite(spots).all(-1) & torch.isfinite(shifted).all(-1)
    conditions = with_real_beams(merit, values, conditions)
    return replace(
        conditions,
        shifts=torch.where(fine[:, None], shifted, conditions.shifts),
        field_weights=torch.where(fine[:, None], weights, conditions.field_weights),
    )


def _minimised(
    merit: SearchMerit, values: Tensor, conditions: Conditions, iterations: int, tolerance: float
) -> BatchResult:
    lower, upper = merit.box(values)

    def evaluate(which: Tensor, u: Tensor) -> BatchModel:
        parts = zip(which.split(_AT_A_TIME), u.split(_AT_A_TIME), strict=True)
        found = [merit.evaluate(v, conditions.chosen(w)) for w, v in parts]
        return found[0] if len(found) == 1 else BatchModel.joined(found)

    return minimise_batch(evaluate, values, lower, upper, iterations, tolerance)


def _described(
    merit: SearchMerit,
    values: Tensor,
    starts: Tensor,
    iterations: int,
    conditions: Conditions | None = None,
) -> Grown:
    if conditions is None:
        conditions = merit.full(len(values))
    spots = merit.spots(values, conditions)
    deviations = merit.deviations(values, conditions)
    violation = torch.where(merit.is_limit, deviations.clamp(min=0.0), deviations.abs())
    return Grown(values, starts, spots, violation.amax(-1), iterations)
