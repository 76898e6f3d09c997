"""Trials of real glasses in designs whose other glasses are held or still continuous."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.dispersion_coordinates import nearest, spread


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
    merit by 2 b·δ + δ·H δ.  `dolens.lens_search.glass.glass_step` makes it from a Jacobian.

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
class JudgedTrials:
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

    def take(self, chosen: Tensor) -> "JudgedTrials":
        """Return some of the designs, or some of them several times."""
        model = self.model and GlassModel(*(part[chosen] for part in self.model))
        return JudgedTrials(
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


def joined(several: Sequence[JudgedTrials]) -> JudgedTrials:
    """Return all designs of several batches."""
    parts = [designs for designs in several if len(designs.merit)] or several[:1]
    models = [designs.model for designs in parts if designs.model]
    return JudgedTrials(
        joined_trials([designs.trials for designs in parts]),
        torch.cat([designs.merit for designs in parts]),
        torch.cat([designs.total for designs in parts]),
        torch.cat([designs.expected for designs in parts]),
        GlassModel(*(torch.cat(part) for part in zip(*models, strict=True))) if models else None,
    )


def best_of_each_lens(designs: JudgedTrials, count: int) -> JudgedTrials:
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


# A merit that is smaller is 0.
_SMALLEST = 1e-30


@dataclass(frozen=True)
class SnapSettings:
    """How many trials snapping makes.

    Attributes:
        neighbours: real glasses tried for a glass.
        far: glasses from all over the set that are tried for the first one, besides.
        beam: designs of each lens kept at each step.
        pair_neighbours: real glasses tried for each of two that are exchanged at once; 0: none are.
        rounds: of exchanges at most; 0: none.
        least_gain: a round of exchanges helps where the total falls by more than this share.
    """

    neighbours: int = 6
    far: int = 32
    beam: int = 6
    pair_neighbours: int = 3
    rounds: int = 10
    least_gain: float = 1e-6

    def __post_init__(self) -> None:
        for name, least in (
            ("neighbours", 1),
            ("beam", 1),
            ("far", 0),
            ("pair_neighbours", 0),
            ("rounds", 0),
        ):
            if getattr(self, name) < least:
                raise InputError(f"snapping: {name} must be at least {least}")
        if not self.least_gain >= 0.0:
            raise InputError("snapping: least_gain must be at least 0")


class TrialGlasses:
    """Makes trials of a set of real glasses, and has them optimised.

    Attributes:
        settings: how many trials are made.
    """

    def __init__(
        self,
        glasses: Tensor,
        reoptimise: Reoptimise,
        settings: SnapSettings,
        cost: Tensor | None = None,
    ) -> None:
        """See `dolens.lens_search.glass.glass_step.snap_glasses` for what is given."""
        self._glasses = glasses
        self._reoptimise = reoptimise
        self.settings = settings
        self._cost = torch.zeros_like(glasses[:, 0]) if cost is None else cost.to(glasses)

    def optimised(self, trials: GlassTrials) -> JudgedTrials:
        """Return the trials after optimisation, without those that failed."""
        if len(trials.lens) == 0:
            nothing = trials.variables.new_zeros(0)
            return JudgedTrials(trials, nothing, nothing, nothing)
        merit, variables, coordinates, model = self._reoptimise(trials)
        held = trials.numbers >= 0
        coordinates = torch.where(held[..., None], trials.coordinates, coordinates)
        rise = self._rises(coordinates, model)
        # What a free glass is expected to become, at what rise of the squared merit and what cost.
        slope = 0.5 / merit.clamp(min=_SMALLEST)[:, None, None]
        least = (slope * rise + self._cost).argmin(2)
        cost = self._cost[torch.where(held, trials.numbers, least)].sum(1)
        rise = (
            rise.gather(2, least[..., None])[..., 0] if model else torch.zeros_like(held).to(merit)
        )
        risen = (merit**2 + (rise * ~held).sum(1)).clamp(min=0.0).sqrt()
        found = GlassTrials(trials.lens, variables, coordinates, trials.numbers)
        designs = JudgedTrials(found, merit, merit + cost, risen + cost, model)
        return designs.take(torch.isfinite(designs.total).nonzero()[:, 0])

    def _rises(self, points: Tensor, model: GlassModel | None) -> Tensor:
        """Return how much the squared merit is expected to rise, (T, P, K), with the real glasses.

        Without a model it is the squared distance.

        Args:
            points: (T, P, C), where glasses are.
            model: of these glasses.
        """
        shift = self._glasses - points[:, :, None]
        if model is None:
            return (shift**2).sum(-1)
        rise = 2.0 * torch.einsum("tpkc,tpc->tpk", shift, model.slopes)
        return rise + torch.einsum("tpkc,tpcd,tpkd->tpk", shift, model.curvatures, shift)

    def one_more_fixed(self, designs: JudgedTrials) -> GlassTrials:
        """Return, for each free glass of each design, those with a real glass in its place."""
        row, glass = (designs.trials.numbers < 0).nonzero(as_tuple=True)
        return self.replaced(designs.take(row), glass[:, None], self.settings.neighbours)

    def far_glasses(self, designs: JudgedTrials) -> GlassTrials:
        """Return, for each free glass of each design, those with glasses from all over the set."""
        row, glass = (designs.trials.numbers < 0).nonzero(as_tuple=True)
        far = spread(self._glasses, self.settings.far)
        return _with_glasses(
            take(designs.trials, row.repeat_interleave(len(far))),
            glass.repeat_interleave(len(far))[:, None],
            far.repeat(len(row))[:, None],
            self._glasses,
        )

    def replaced(self, designs: JudgedTrials, slots: Tensor, count: int) -> GlassTrials:
        """Return the designs with every combination of real glasses in some places.

        Args:
            designs: T of them.
            slots: (T, P), which P glasses are replaced in each.
            count: real glasses tried for each; a real one there is itself not counted.
        """
        candidates = self._candidates(designs, slots, count)
        pick = torch.cartesian_prod(*[torch.arange(candidates.shape[2])] * slots.shape[1])
        pick = pick.reshape(-1, slots.shape[1]).to(slots.device)
        rows = torch.arange(len(slots), device=slots.device).repeat_interleave(len(pick))
        chosen = candidates[rows].gather(2, pick.repeat(len(slots), 1)[..., None])[..., 0]
        return _with_glasses(take(designs.trials, rows), slots[rows], chosen, self._glasses)

    def _candidates(self, designs: JudgedTrials, slots: Tensor, count: int) -> Tensor:
        """Return the numbers (T, P, count) of the real glasses to try in some places.

        Half of them are the nearest, the others those of which the model expects most.
        """
        rows = torch.arange(len(slots), device=slots.device)[:, None]
        points = designs.trials.coordinates[rows, slots]
        # The nearest glass of a real one is itself.
        count = min(
            count + int(bool((designs.trials.numbers[rows, slots] >= 0).all())), len(self._glasses)
        )
        if designs.model is None:
            return nearest(points, self._glasses, count)[1]
        close = nearest(points, self._glasses, (count + 1) // 2)[1]
        model = GlassModel(*(part[rows, slots] for part in designs.model))
        rise = self._rises(points, model)
        total = (designs.merit[:, None, None] ** 2 + rise).clamp(min=0.0).sqrt() + self._cost
        total = total.scatter(2, close, torch.inf)
        promising = total.topk(count - close.shape[2], dim=2, largest=False).indices
        return torch.cat([close, promising], dim=2)


def _with_glasses(
    trials: GlassTrials, slots: Tensor, numbers: Tensor, glasses: Tensor
) -> GlassTrials:
    """Return the trials with real glasses (T, P) in some of their places (T, P)."""
    places = slots[..., None].expand(-1, -1, trials.coordinates.shape[-1])
    return trials._replace(
        coordinates=trials.coordinates.scatter(1, places, glasses[numbers]),
        numbers=trials.numbers.scatter(1, slots, numbers),
    )
