"""Continuous glasses become catalogue glasses, one by one, in the order that costs least.

At each step every free glass is tried as each of the real glasses next to it, and the lens is
optimised again with that one held; of all these trials the best few are kept (a beam), so that the
glass which costs least is fixed first and those left can make up for it.  When all are fixed,
glasses are exchanged (see `dolens.lens_search.glass.exchanges`).

All trials of a step, of all lenses, are one batch for the caller's `reoptimise`.
"""

from dataclasses import dataclass

from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.designs import (
    Designs,
    GlassTrials,
    Reoptimise,
    best_of_each_lens,
    joined,
    unseen,
)
from dolens.lens_search.glass.exchanges import exchanged
from dolens.lens_search.glass.trial_glasses import SnapSettings, TrialGlasses


@dataclass(frozen=True)
class Snapped:
    """Lenses of catalogue glasses.

    Attributes:
        designs: the best of each lens, in the order of the lenses' numbers; a lens whose every
            trial failed is not among them.
        fixed: the same before glasses were exchanged.
        continuous: the lenses at the start, optimised with continuous glasses.
        several: the best few of each lens, different in their glasses, the best first.
        trials: how many lenses were optimised.
    """

    designs: Designs
    fixed: Designs
    continuous: Designs
    several: Designs
    trials: int


def snap_glasses(
    start: GlassTrials,
    glasses: Tensor,
    reoptimise: Reoptimise,
    settings: SnapSettings | None = None,
    cost: Tensor | None = None,
    weights: Tensor | None = None,
) -> Snapped:
    """Return lenses with catalogue glasses in place of their continuous ones.

    Args:
        start: L lenses, different in their numbers; glasses whose number is not -1 are held
            throughout.
        glasses: (K, C), the coordinates of the real glasses.
        reoptimise: optimises a batch of trials, each from where it stands.
        settings: how many trials are made.
        cost: (K,), added to the merit for each glass of a lens; a free glass counts as the nearest.
        weights: (C,), of the coordinates in the distance of two glasses.

    Raises:
        InputError: there are no glasses, or two lenses have one number.
    """
    if glasses.ndim != 2 or len(glasses) == 0:
        raise InputError("snapping: there is no glass to choose from")
    if len(start.lens.unique()) < len(start.lens):
        raise InputError("snapping: two lenses have the same number")
    work = TrialGlasses(glasses, reoptimise, settings or SnapSettings(), cost, weights)
    continuous = designs = best_of_each_lens(work.optimised(start), 1)
    far = work.optimised(unseen(work.far_glasses(designs), set()))
    while bool((designs.trials.numbers < 0).any()):
        free = (designs.trials.numbers < 0).any(1)
        tried = work.optimised(unseen(work.one_more_fixed(designs.take(free)), set()))
        designs = best_of_each_lens(joined([designs.take(~free), far, tried]), work.settings.beam)
        far = far.take(far.trials.lens[:0])
    held = {
        lens: row.tolist()
        for lens, row in zip(start.lens.tolist(), start.numbers >= 0, strict=True)
    }
    final = exchanged(work, designs, held)
    return Snapped(_in_order(final), _in_order(designs), _in_order(continuous), final, work.count)


def _in_order(designs: Designs) -> Designs:
    """Return the best design of each lens in the order of the lenses' numbers."""
    best = best_of_each_lens(designs, 1)
    return best.take(best.trials.lens.argsort())
