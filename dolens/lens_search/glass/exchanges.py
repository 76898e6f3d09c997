"""Glasses of finished designs are exchanged, one at a time and then two, while that helps.

A glass is exchanged for the real glasses next to it, and for those next to what it becomes when it
is set free and the lens is optimised with it.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

import torch
from torch import Tensor

from dolens.lens_search.glass.designs import (
    Designs,
    GlassTrials,
    best_of_each_lens,
    joined,
    joined_trials,
    keys,
    unseen,
)
from dolens.lens_search.glass.trial_glasses import TrialGlasses


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
