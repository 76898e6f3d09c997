"""Lenses with some glasses held and others free are optimised, for snapping."""

import torch
from torch import Tensor

from dolens.lens_search.conditions import Conditions
from dolens.lens_search.glass.designs import GlassModel, GlassTrials, Reoptimise, Reoptimised
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.glass_models import glass_models
from dolens.lens_search.glass.own_glasses import FREE
from dolens.optimize.batch_least_squares import BatchModel, minimise_batch

# A free glass this near to a wall leans on it, and a variable this near to a bound on that.
_NEAR_WALL, _NEAR_BOUND = 1e-2, 1e-9
# Lenses evaluated together: their arrays then stay in the processor's cache.
_AT_A_TIME = 512


def reoptimiser(
    merit: GlassMerit, conditions: Conditions, iterations: int, merit_tolerance: float = 1e-4
) -> Reoptimise:
    """Return the callback of `snap_glasses` for lenses of a search.

    What is made small is Σ ω·spot² with operands and walls, and the merit that is returned is the
    mean of the spots over the focal length, as that of a search is.  The rest of the augmented
    Lagrangian, without what shifts add where operands hold, counts as such an increase of the mean:
    with ω ~ 1/spot, d(mean) is d(Σ ω·spot²)·mean(1/spot)/2.

    Args:
        merit: of lenses and glasses.
        conditions: of L lenses; a trial's lens is its number among them.
        iterations: of damped least squares at most.
        merit_tolerance: see `minimise_batch`.
    """
    shifted = merit.operand_weight**2 * conditions.shifts.square().sum(1)

    def run(trials: GlassTrials) -> Reoptimised:
        u = merit.with_glasses(trials.variables, trials.coordinates, trials.numbers)
        asked = conditions.chosen(trials.lens)
        lower, upper = merit.box(u)

        def evaluate(which: Tensor, values: Tensor) -> BatchModel:
            parts = zip(which.split(_AT_A_TIME), values.split(_AT_A_TIME), strict=True)
            return BatchModel.joined([merit.evaluate(v, asked.chosen(w)) for w, v in parts])

        found = minimise_batch(evaluate, u, lower, upper, iterations, merit_tolerance)
        at = found.values
        optical = merit.optical(at, asked)
        coordinates = merit.coordinates(at)
        free = (at > lower + _NEAR_BOUND) & (at < upper - _NEAR_BOUND)
        leaning = (merit.region.excess(coordinates) > -_NEAR_WALL).any(-1, keepdim=True)
        first = merit.arrangement.variables
        last = first + coordinates[0].numel()
        free[:, first:last] &= ~leaning.expand_as(coordinates).flatten(1)
        usable = torch.isfinite(found.merit)
        hessian, gradient = optical.hessian[:, :last, :last], optical.gradient[:, :last]
        model = glass_models(
            torch.where(usable[:, None, None], hessian, 0.0),
            torch.where(usable[:, None], gradient, 0.0),
            free[:, :last],
            merit.shape,
        )
        spots = merit.spots(at, asked) / merit.specification.focal_length
        square = (asked.field_weights * spots.square()).sum(1)
        rest = found.merit - shifted[trials.lens] - square
        mean = spots.mean(1)
        whole = mean + 0.5 * rest * (1.0 / spots.clamp(min=1e-12)).mean(1)
        # The model is of the squared merit, in its own unit.
        unit = (mean.square() / square.clamp(min=1e-30)).nan_to_num(1.0)[:, None, None]
        model = GlassModel(unit * model.slopes, unit[..., None] * model.curvatures)
        whole = torch.where(usable, whole.clamp(min=0.0), torch.inf)
        return Reoptimised(whole, at[:, :first], coordinates, model)

    return run


def free_trials(merit: GlassMerit, u: Tensor) -> GlassTrials:
    """Return lenses u as trials, in their order, whose glasses vary."""
    return GlassTrials(
        torch.arange(len(u)),
        u[:, : merit.arrangement.variables],
        merit.coordinates(u),
        torch.full_like(merit.numbers(u), FREE),
    )
