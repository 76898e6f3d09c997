"""Batches of designs whose glasses are partly catalogue glasses and partly still continuous."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class GlassTrials(NamedTuple):
    """Designs to be optimised with some of their glasses held.

    Attributes:
        lens: (T,), the number of the lens that a trial began with.
        variables: (T, V), what varies besides the glasses.
        coordinates: (T, G, C), of the glasses; of a held one those of the catalogue glass.
        numbers: (T, G), of the catalogue glass; -1 where the glass is free.
    """

    lens: Tensor
    variables: Tensor
    coordinates: Tensor
    numbers: Tensor


class GlassModel(NamedTuple):
    """What each glass's squared merit is expected to be elsewhere.

    Moving one glass by δ, with all that is free optimised again, is expected to change the squared
    merit by 2 b·δ + δ·H δ.  `dolens.lens_search.glass.glass_models` makes it from a Jacobian.

    Attributes:
        slopes: b, (T, G, C).
        curvatures: H, (T, G, C, C).
    """

    slopes: Tensor
    curvatures: Tensor


class Reoptimised(NamedTuple):
    """What optimising a batch of trials gave.

    Attributes:
        merit: (T,), at least 0, the smaller the better; not finite where a trial failed.
        variables: (T, V).
        coordinates: (T, G, C); those of held glasses are not looked at.
        model: of held and free glasses; with it, the glasses that promise most are tried besides
            those that are nearest.
    """

    merit: Tensor
    variables: Tensor
    coordinates: Tensor
    model: GlassModel | None = None


Reoptimise = Callable[[GlassTrials], Reoptimised]


@dataclass(frozen=True)
class Designs:
    """Trials with their merits.

    Attributes:
        trials: T of them.
        merit: (T,).
        total: (T,), the merit and the costs of the glasses; a free glass costs what the one does
            that it is expected to become.
        expected: (T,), the total that is expected when all glasses are real.
        model: see `Reoptimised`.
    """

    trials: GlassTrials
    merit: Tensor
    total: Tensor
    expected: Tensor
    model: GlassModel | None = None

    def take(self, chosen: Tensor) -> "Designs":
        """Return some of the designs, or some of them several times."""
        model = self.model and GlassModel(*(part[chosen] for part in self.model))
        return Designs(
            take(self.trials, chosen),
            self.merit[chosen],
            self.total[chosen],
            self.expected[chosen],
            model,
        )


def take(trials: GlassTrials, chosen: Tensor) -> GlassTrials:
    """Return some of the trials, or some of them several times."""
    return GlassTrials(*(part[chosen] for part in trials))


def joined_trials(several: Sequence[GlassTrials]) -> GlassTrials:
    """Return all trials of several batches."""
    return GlassTrials(*(torch.cat(parts) for parts in zip(*several, strict=True)))


def joined(several: Sequence[Designs]) -> Designs:
    """Return all designs of several batches."""
    parts = [designs for designs in several if len(designs.merit)] or several[:1]
    models = [designs.model for designs in parts if designs.model]
    return Designs(
        joined_trials([designs.trials for designs in parts]),
        torch.cat([designs.merit for designs in parts]),
        torch.cat([designs.total for designs in parts]),
        torch.cat([designs.expected for designs in parts]),
        GlassModel(*(torch.cat(part) for part in zip(*models, strict=True))) if models else None,
    )


def best_of_each_lens(designs: Designs, count: int) -> Designs:
    """Return at most that many designs of each lens, different in their glasses, best first.

    The best are those that are expected to be it when all glasses are real.
    """
    order = designs.expected.argsort(stable=True)
    seen: dict[int, set[tuple[int, ...]]] = {}
    kept = []
    for at, key in zip(order.tolist(), keys(take(designs.trials, order)), strict=True):
        of_lens = seen.setdefault(key[0], set())
        if len(of_lens) < count and key not in of_lens:
            of_lens.add(key)
            kept.append(at)
    return designs.take(torch.tensor(kept, dtype=torch.long, device=order.device))


def keys(trials: GlassTrials) -> list[tuple[int, ...]]:
    """Return the number of the lens and those of its glasses, of every trial."""
    rows = torch.cat([trials.lens[:, None], trials.numbers], dim=1).tolist()
    return [tuple(row) for row in rows]


def unseen(trials: GlassTrials, seen: set[tuple[int, ...]]) -> GlassTrials:
    """Return the first trial of each choice of glasses that is not in `seen`."""
    fresh: dict[tuple[int, ...], int] = {}
    for at, key in enumerate(keys(trials)):
        if key not in seen:
            fresh.setdefault(key, at)
    chosen = torch.tensor(list(fresh.values()), dtype=torch.long, device=trials.numbers.device)
    return take(trials, chosen)
