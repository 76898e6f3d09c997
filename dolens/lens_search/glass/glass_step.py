"""The best forms of a search get catalogue glasses.

The glasses of a form become continuous and are optimised with the lens, as `finish` does it, until
operands hold.  Then they are snapped and exchanged (see `snapping`), and the lenses that come of it
are finished with their glasses held.
"""

from dataclasses import dataclass, field

import torch

from dolens.errors import InputError
from dolens.lens_search.designs import Designs
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.reoptimisation import free_trials, reoptimiser
from dolens.lens_search.glass.snapping import snap_glasses
from dolens.lens_search.glass.trial_glasses import SnapSettings
from dolens.lens_search.growth import Grown, finish, settled


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


@dataclass(frozen=True)
class RealGlasses:
    """What became of forms whose glasses were made real.

    Attributes:
        designs: with catalogue glasses.
        continuous: least mean RMS spot with continuous glasses, mm: of the form itself, or of the
            best of `designs` with its glasses set free again.
        trials: lenses that were optimised.
        iterations: of those that were finished.
    """

    designs: Designs
    continuous: float
    trials: int
    iterations: int


def with_real_glasses(
    merit: GlassMerit,
    plan: GlassPlan,
    form: Designs,
    rounds: int,
    iterations: int,
    tolerance: float,
) -> RealGlasses:
    """Return a form with catalogue glasses, in several choices of these.

    Args:
        merit: of its arrangement, with the rays that decide.
        plan: how much.
        form: one design.
        rounds: of finishing, see `finish`.
        iterations: of a round.
        tolerance: by how much an operand may fail.
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
    found = snap_glasses(start, merit.glasses.coordinates, optimise, plan.snapping, cost)
    trials = found.several.trials
    u = merit.with_glasses(trials.variables, trials.coordinates, trials.numbers)
    held = merit.held()
    none = torch.zeros(len(u), dtype=torch.float64)
    grown = Grown(u, torch.arange(len(u)), none, none, 0, ())
    last = finish(held, grown, rounds, iterations)
    history = (*form.history[0], "glasses")
    designs = Designs(
        form.arrangement,
        last.values,
        last.spots,
        last.violation,
        form.starts.expand(len(u)),
        (history,) * len(u),
    ).keeping(tolerance)
    designs = designs.chosen(designs.ranked_merit(merit).argsort(stable=True)[: plan.kept])
    used = done.iterations + last.iterations
    if len(designs.values):
        again = settled(merit, merit.freed(designs.values[:1]), rounds, iterations)
        spots = again.merit.spots(again.values, again.conditions).mean(-1)
        continuous, used = min(continuous, float(spots)), used + again.iterations
    return RealGlasses(designs, continuous, found.trials, used)
