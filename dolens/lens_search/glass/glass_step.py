"""The best forms of a search get catalogue glasses.

The glasses of a form become continuous and are optimised with the lens, as `finish` does it, until
operands hold.  Then they become catalogue glasses, one by one, in the order that costs least: at
each step every free glass is tried as each of the real glasses next to it, and the lens is
optimised again with that one held; of all these trials the best few are kept (a beam), so that the
glass which costs least is fixed first and those left can make up for it.  All trials of a step, of
all lenses, are one batch for `reoptimiser`.  When all are fixed, glasses are exchanged, one at a
time and then two, while that helps: for the real glasses next to one, and for those next to what
it becomes when it is set free and the lens is optimised with it.  The lenses that come of it are
finished with their glasses held.

How much a lens expects of other glasses is a quadratic model from its residuals' Jacobian.  With
residuals r and the Jacobian J with respect to everything, variables and coordinates of all
glasses, the squared merit near a design is |r + J s|².  For one glass moved by δ, the step of all
that is free is the one that makes this smallest (a Schur complement), and what remains is
2 b·δ + δ·H δ.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.designs import Designs
from dolens.lens_search.glass.glass_family import FREE
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.trial_glasses import (
    GlassModel,
    GlassTrials,
    JudgedTrials,
    Reoptimise,
    Reoptimised,
    SnapSettings,
    TrialGlasses,
    best_of_each_lens,
    joined,
    joined_trials,
    keys,
    unseen,
)
from dolens.lens_search.growth import Grown, finish, settled
from dolens.lens_search.search_rays import Conditions
from dolens.optimize.batch_least_squares import BatchModel, minimise_batch


@dataclass(frozen=True)
class GlassPlan:
    """Says how much is searched for glasses; it counts where a specification lets them be chosen.

    Attributes:
        in_growth: whether glasses vary while lenses grow; else starts keep theirs.
        forms: best forms whose glasses become continuous, and then real.
        kept: lenses of each form that are kept, different in their glasses.
        apart: whether lenses that differ in their glasses alone are different forms.
        snapping: how many trials are made.
        iterations: of a trial.
        rings: of the rays of trials.
        arms: of these.

    Raises:
        InputError: a number out of range.
    """

    in_growth: bool = True
    forms: int = 12
    kept: int = 1
    apart: bool = False
    snapping: SnapSettings = field(default_factory=SnapSettings)
    iterations: int = 40
    rings: int = 3
    arms: int = 6

    def __post_init__(self) -> None:
        for name in ("forms", "kept", "iterations", "rings", "arms"):
            if getattr(self, name) < 1:
                raise InputError(f"plan.glass.{name} must be 1 or more, not {getattr(self, name)}")


def with_real_glasses(
    merit: GlassMerit,
    plan: GlassPlan,
    form: Designs,
    rounds: int,
    iterations: int,
    tolerance: float,
) -> tuple[Designs, float, int]:
    """Return a form with catalogue glasses, in several choices of these.

    Args:
        merit: of its arrangement, with the rays that decide.
        plan: how much.
        form: one design.
        rounds: of finishing, see `finish`.
        iterations: of a round.
        tolerance: by how much an operand may fail.

    Returns:
        The designs; the least mean RMS spot with continuous glasses, mm: of the form itself, or of
        the best of the designs with its glasses set free again; and the iterations of those that
        were finished.
    """
    done = settled(merit, merit.freed(form.values), rounds, iterations)
    firm = done.merit
    assert isinstance(firm, GlassMerit)  # what is settled keeps its kind
    continuous = float(firm.spots(done.values, done.conditions).mean(-1))
    sampled = firm.sampled(plan.rings, plan.arms)
    assert isinstance(sampled, GlassMerit)
    optimise = reoptimiser(sampled, done.conditions, plan.iterations)
    start = free_trials(merit, done.values)
    cost = None
    choice = merit.specification.glass_choice
    if choice is not None and choice.costs:
        cost = optimise(start).merit[0] * merit.glasses.costs(choice.costs)
    trials = snap_glasses(start, merit.glasses.coordinates, optimise, plan.snapping, cost).trials
    u = merit.with_glasses(trials.variables, trials.coordinates, trials.numbers)
    held = merit.held()
    none = torch.zeros(len(u), dtype=torch.float64)
    grown = Grown(u, torch.arange(len(u)), none, none, 0)
    last = finish(held, grown, rounds, iterations)
    history = (*form.history[0], "glasses")
    starts, histories = form.starts.expand(len(u)), (history,) * len(u)
    designs = Designs.of(form.arrangement, last, starts, histories).keeping(tolerance)
    designs = designs.chosen(designs.ranked_merit(merit).argsort(stable=True)[: plan.kept])
    used = done.iterations + last.iterations
    if len(designs.values):
        again = settled(merit, merit.freed(designs.values[:1]), rounds, iterations)
        spots = again.merit.spots(again.values, again.conditions).mean(-1)
        continuous, used = min(continuous, float(spots)), used + again.iterations
    return designs, continuous, used


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


# Share of the largest diagonal element added to what is eliminated, which may be singular.
_RIDGE = 1e-12


def glass_models(
    gram: Tensor, gradient: Tensor, free: Tensor, shape: tuple[int, int]
) -> GlassModel:
    """Return the model of each glass of a batch of designs.

    Args:
        gram: JᵀJ, (T, N, N), of N = V + G C unknowns, those of the glasses last.
        gradient: Jᵀr, (T, N).
        free: (T, N), which unknowns are optimised again when a glass moves; those of the glass
            itself are never, and variables at a bound had better not be.
        shape: G and C.
    """
    glasses, count = shape
    first = gram.shape[-1] - glasses * count
    slopes, curvatures = [], []
    for glass in range(glasses):
        own = torch.zeros_like(free[0])
        own[first + glass * count : first + (glass + 1) * count] = True
        others = free & ~own
        slope, curvature = _eliminated(gram, gradient, own, others)
        slopes.append(slope)
        curvatures.append(curvature)
    return GlassModel(torch.stack(slopes, 1), torch.stack(curvatures, 1))


def _eliminated(
    gram: Tensor, gradient: Tensor, own: Tensor, others: Tensor
) -> tuple[Tensor, Tensor]:
    """Return gradient and Gram matrix of one glass with the free others eliminated."""
    mask = others.to(gram)
    diagonal = gram.diagonal(dim1=1, dim2=2)
    ridge = _RIDGE * (diagonal * mask).amax(1, keepdim=True) + torch.finfo(gram.dtype).tiny
    # Rows and columns of what is held become those of the unit matrix.
    among = gram * mask[:, :, None] * mask[:, None, :] + torch.diag_embed(
        torch.where(others, ridge, torch.ones_like(mask))
    )
    across = gram[:, :, own] * mask[:, :, None]
    right = torch.cat([across, (gradient * mask)[..., None]], dim=2)
    solved = torch.linalg.solve(among, right)
    change = across.transpose(1, 2) @ solved
    return gradient[:, own] - change[..., -1], gram[:, own][:, :, own] - change[..., :-1]


def snap_glasses(
    start: GlassTrials,
    glasses: Tensor,
    reoptimise: Reoptimise,
    settings: SnapSettings | None = None,
    cost: Tensor | None = None,
) -> JudgedTrials:
    """Return lenses with catalogue glasses in place of their continuous ones.

    Args:
        start: L lenses, different in their numbers; glasses whose number is not -1 are held
            throughout.
        glasses: (K, C), the coordinates of the real glasses.
        reoptimise: optimises a batch of trials, each from where it stands.
        settings: how many trials are made.
        cost: (K,), added to the merit for each glass of a lens; a free glass counts as the nearest.

    Returns:
        The best few of each lens, different in their glasses, the best first.  A lens whose every
        trial failed is not among them.

    Raises:
        InputError: there are no glasses, or two lenses have one number.
    """
    if glasses.ndim != 2 or len(glasses) == 0:
        raise InputError("snapping: there is no glass to choose from")
    if len(start.lens.unique()) < len(start.lens):
        raise InputError("snapping: two lenses have the same number")
    work = TrialGlasses(glasses, reoptimise, settings or SnapSettings(), cost)
    designs = best_of_each_lens(work.optimised(start), 1)
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
    return exchanged(work, designs, held)


def exchanged(
    work: TrialGlasses, designs: JudgedTrials, held: Mapping[int, Sequence[bool]]
) -> JudgedTrials:
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
    finished: list[JudgedTrials] = []
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
    designs: JudgedTrials,
    held: Mapping[int, Sequence[bool]],
    together: int,
    seen: set[tuple[int, ...]],
) -> JudgedTrials:
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


def _is_better(after: JudgedTrials, before: JudgedTrials, least_gain: float) -> Tensor:
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
