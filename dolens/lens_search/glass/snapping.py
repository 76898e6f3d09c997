"""Continuous glasses become catalogue glasses, one by one, in the order that costs least.

At each step every free glass is tried as each of the real glasses next to it, and the lens is
optimised again with that one held; of all these trials the best few are kept (a beam), so that
the glass which costs least is fixed first and those left can make up for it.  All trials of a
step, of all lenses, are one batch for the caller's `reoptimise`.

When all are fixed, glasses are exchanged, one at a time and then two, while that helps: for the
real glasses next to one, and for those next to what it becomes when it is set free and the lens
is optimised with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.trial_glasses import (
    Designs,
    GlassTrials,
    Reoptimise,
    SnapSettings,
    TrialGlasses,
    best_of_each_lens,
    joined,
    joined_trials,
    keys,
    unseen,
)


@dataclass(frozen=True)
class Snapped:
    """Lenses of catalogue glasses.

    Attributes:
        designs: the best of each lens, in the order of the lenses' numbers; a lens whose every
            trial failed is not among them.
        fixed: the same before glasses were exchanged.
        continuous: the lenses at the start, optimised with continuous glasses.
        several: the best few of each lens, different in their glasses, the best first.
    """

    designs: Designs
    fixed: Designs
    continuous: Designs
    several: Designs


def snap_glasses(
    start: GlassTrials,
    glasses: Tensor,
    reoptimise: Reoptimise,
    settings: SnapSettings | None = None,
    cost: Tensor | None = None,
) -> Snapped:
    """Return lenses with catalogue glasses in place of their continuous ones.

    Args:
        start: L lenses, different in their numbers; glasses whose number is not -1 are held
            throughout.
        glasses: (K, C), the coordinates of the real glasses.
        reoptimise: optimises a batch of trials, each from where it stands.
        settings: how many trials are made.
        cost: (K,), added to the merit for each glass of a lens; a free glass counts as the nearest.

    Raises:
        InputError: there are no glasses, or two lenses have one number.
    """
    if glasses.ndim != 2 or len(glasses) == 0:
        raise InputError("snapping: there is no glass to choose from")
    if len(start.lens.unique()) < len(start.lens):
        raise InputError("snapping: two lenses have the same number")
    work = TrialGlasses(glasses, reoptimise, settings or SnapSettings(), cost)
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
    return Snapped(_in_order(final), _in_order(designs), _in_order(continuous), final)


def _in_order(designs: Designs) -> Designs:
    """Return the best design of each lens in the order of the lenses' numbers."""
    best = best_of_each_lens(designs, 1)
    return best.take(best.trials.lens.argsort())


def exchanged(work: TrialGlasses, designs: Designs, held: Mapping[int, Sequence[bool]]) -> Designs:
    """Return the designs after exchanges, the best few of each lens.

    A round exchanges single glasses of every design; where that does not help a lens, pairs of
    glasses of its best design.  A lens that neither helps is finished.

    Args:
        work: makes the trials.
        designs: with real glasses everywhere.
        held: number of a lens → which of its glasses are not exchanged.
    """
    settings = work.settings
    seen = set(keys(designs.trials))
    finished: list[Designs] = []
    for _ in range(settings.rounds):
        if len(designs.total) == 0:
            break
        after = _moved(work, designs, held, 1, seen)
        stuck = ~_is_better(after, designs, settings.least_gain)
        if settings.pair_neighbours and bool(stuck.any()):
            pairs = _moved(work, best_of_each_lens(after.take(stuck), 1), held, 2, seen)
            after = best_of_each_lens(joined([after, pairs]), settings.beam)
        going = _is_better(after, designs, settings.least_gain)
        finished.append(after.take(~going))
        designs = after.take(going)
    return best_of_each_lens(joined([*finished, designs]), settings.beam)


def _moved(
    work: TrialGlasses,
    designs: Designs,
    held: Mapping[int, Sequence[bool]],
    together: int,
    seen: set[tuple[int, ...]],
) -> Designs:
    """Return the best designs after so many glasses at a time were exchanged, and before."""
    rows, slots = _places(designs.trials, held, together)
    if len(rows) == 0:
        return designs
    count = work.settings.neighbours if together == 1 else work.settings.pair_neighbours
    start = designs.take(rows)
    before = start.trials
    freed = unseen(before._replace(numbers=before.numbers.scatter(1, slots, -1)), seen)
    seen.update(keys(freed))
    free = work.optimised(freed)
    free_slots = (free.trials.numbers < 0).nonzero()[:, 1].reshape(-1, together)
    near = [work.replaced(start, slots, count), work.replaced(free, free_slots, count)]
    trials = unseen(joined_trials(near), seen)
    seen.update(keys(trials))
    return best_of_each_lens(joined([designs, work.optimised(trials)]), work.settings.beam)


def _places(
    trials: GlassTrials, held: Mapping[int, Sequence[bool]], together: int
) -> tuple[Tensor, Tensor]:
    """Return each way to take so many glasses of a trial: its row, (M,), and places, (M, P)."""
    rows, slots = [], []
    for row, lens in enumerate(trials.lens.tolist()):
        places = [place for place, is_held in enumerate(held[lens]) if not is_held]
        for chosen in combinations(places, together):
            rows.append(row)
            slots.append(chosen)
    device = trials.numbers.device
    return (
        torch.tensor(rows, dtype=torch.long, device=device),
        torch.tensor(slots, dtype=torch.long, device=device).reshape(-1, together),
    )


def _is_better(after: Designs, before: Designs, least_gain: float) -> Tensor:
    """Return, for each design, whether the best of its lens is better than it was before."""
    best: list[dict[int, float]] = []
    for designs in (after, before):
        totals: dict[int, float] = {}
        for lens, total in zip(designs.trials.lens.tolist(), designs.total.tolist(), strict=True):
            totals[lens] = min(total, totals.get(lens, total))
        best.append(totals)
    now, then = best
    better = {lens: now[lens] < then[lens] - least_gain * abs(then[lens]) for lens in now}
    lenses = after.trials.lens.tolist()
    return torch.tensor([better[lens] for lens in lenses], dtype=torch.bool).to(after.total.device)
