"""Lenses with some glasses held and others free are optimised, for snapping."""

from collections.abc import Callable

import torch
from torch import Tensor

from dolens.lens_search.glass.designs import GlassTrials, Reoptimise, Reoptimised
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.glass_models import glass_models
from dolens.lens_search.merit import Conditions
from dolens.optimize.batch_least_squares import BatchModel, minimise_batch

# Continuous glasses may leave the box about the real ones by so much; walls hold them nearer.
_BEYOND = 0.5
# A free glass this near to a wall leans on it, and a variable this near to a bound on that.
_NEAR_WALL, _NEAR_BOUND = 1e-2, 1e-9


def reoptimiser(
    merit: GlassMerit,
    conditions: Conditions,
    iterations: int,
    merit_tolerance: float = 1e-4,
    bounds: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> Reoptimise:
    """Return the callback of `snap_glasses` for lenses of a search.

    Args:
        merit: of lenses and glasses.
        conditions: of L lenses; a trial's lens is its number among them.
        iterations: of damped least squares at most.
        merit_tolerance: see `minimise_batch`.
        bounds: the box of the lens's variables; None: that of the merit.
    """
    lower, upper = (bounds or merit.base.bounds)()
    glasses = merit.glasses.coordinates
    least, most = glasses.amin(0) - _BEYOND, glasses.amax(0) + _BEYOND

    def run(trials: GlassTrials) -> Reoptimised:
        u = torch.cat([trials.variables, trials.coordinates.flatten(1)], 1)
        held = (trials.numbers >= 0)[..., None]
        low = torch.where(held, trials.coordinates, least).flatten(1)
        high = torch.where(held, trials.coordinates, most).flatten(1)
        low = torch.cat([lower.expand(len(u), -1), low], 1)
        high = torch.cat([upper.expand(len(u), -1), high], 1)
        asked = conditions.chosen(trials.lens)

        def evaluate(which: Tensor, values: Tensor) -> BatchModel:
            return merit.evaluate(values, trials.numbers[which], asked.chosen(which))

        found = minimise_batch(evaluate, u, low, high, iterations, merit_tolerance)
        at = found.values
        optical = merit.optical(at, trials.numbers, asked)
        coordinates = merit.coordinates(at)
        free = (at > low + _NEAR_BOUND) & (at < high - _NEAR_BOUND)
        leaning = (merit.region.excess(coordinates) > -_NEAR_WALL).any(-1, keepdim=True)
        first = merit.base.arrangement.variables
        free[:, first:] &= ~leaning.expand_as(coordinates).flatten(1)
        usable = torch.isfinite(found.merit)
        model = glass_models(
            torch.where(usable[:, None, None], optical.hessian, 0.0),
            torch.where(usable[:, None], optical.gradient, 0.0),
            free,
            merit.shape,
        )
        return Reoptimised(found.merit.sqrt(), at[:, :first], coordinates, model)

    return run
