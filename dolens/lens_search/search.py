"""The search: starts are grown in batches, and the best forms lead to others.

Each step is a list of tasks whose results depend on the task alone, so that tasks can run in any
process and a search can be taken up again where it was stopped.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs, best_forms, element_powers, parents_of, shares
from dolens.lens_search.glass.glass_merit import GlassMerit, merit_of
from dolens.lens_search.glass.glass_step import GlassPlan, with_real_glasses
from dolens.lens_search.growth import STAGES, Grown, Stage, finish, grow
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.specification import Specification
from dolens.lens_search.starts import DRAWN, inserted, random_starts, taken_out
from dolens.tasks import TaskMap


@dataclass(frozen=True)
class SearchPlan:
    """Says how much is searched.

    Attributes:
        starts: random starts, over all places of the stop.
        batch: of one task.
        drawn: lenses that are drawn for a start that is kept.
        stages: of growth.
        finished: share of a batch's grown lenses that are optimised to the end.
        finish_rounds: see `finish`.
        finish_iterations: of a round.
        escapes: rounds in which the best forms lead to others.
        parents: forms of a round that do.
        tolerance: by how much an operand may fail, relative or over the focal length.
        rings: of the rays that decide.
        arms: of these.
        seed: of the starts.
        glass: of searches that choose glasses.

    Raises:
        InputError: a number out of range.
    """

    starts: int = 10_000
    batch: int = 2000
    drawn: int = DRAWN
    stages: tuple[Stage, ...] = STAGES
    finished: float = 0.5
    finish_rounds: int = 6
    finish_iterations: int = 40
    escapes: int = 2
    parents: int = 16
    tolerance: float = 3e-4
    rings: int = 4
    arms: int = 8
    seed: int = 0
    glass: GlassPlan = field(default_factory=GlassPlan)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        for name in (
            "starts",
            "batch",
            "drawn",
            "finish_rounds",
            "finish_iterations",
            "rings",
            "arms",
        ):
            if getattr(self, name) < 1:
                raise InputError(f"plan.{name} must be 1 or more, not {getattr(self, name)}")
        for name in ("escapes", "parents"):
            if getattr(self, name) < 0:
                raise InputError(f"plan.{name} must be 0 or more, not {getattr(self, name)}")
        if not 0.0 < self.finished <= 1.0:
            raise InputError(f"plan.finished must lie above 0 and to 1, not {self.finished}")


@dataclass(frozen=True)
class Step:
    """What one task found.

    Attributes:
        designs: of one arrangement each.
        features: powers of the elements of the starts, (starts, elements); none of an escape.
        first: number of the first start.
        iterations: of all lenses together.
        continuous: mean RMS spot of the form that these are of with continuous glasses, mm; None
            where these were not snapped.
    """

    designs: tuple[Designs, ...]
    features: Tensor
    first: int
    iterations: int
    continuous: float | None = None


# The place of the stop, the number of the first start, and how many.
StartTask = tuple[tuple[int, int], int, int]


def start_tasks(specification: Specification, plan: SearchPlan) -> list[StartTask]:
    """Return the tasks of growth."""
    stops = specification.places_of_stop
    # Every place of the stop has its turn; a round of batches goes through them all.
    rounds = max(1, -(-plan.starts // (plan.batch * len(stops))))
    count = rounds * len(stops)
    bounds = [plan.starts * number // count for number in range(count + 1)]
    return [
        (stops[number % len(stops)], first, last - first)
        for number, (first, last) in enumerate(pairwise(bounds))
        if last > first
    ]


def grown_starts(specification: Specification, plan: SearchPlan, task: StartTask) -> Step:
    """Grow one batch of starts, and finish the better ones."""
    stop, first, count = task
    arrangement = Arrangement.of(specification, *stop)
    merit = merit_of(arrangement, specification, plan.rings, plan.arms, plan.glass.in_growth)
    generator = torch.Generator().manual_seed(1_000_003 * plan.seed + first)
    starts = random_starts(merit, count, generator, plan.drawn)
    grown = grow(merit, starts, plan.stages)
    done = _finished(merit, plan, grown)
    history = (("start",),) * len(done.values)
    designs = Designs.of(arrangement, done, first + done.starts, history)
    features = element_powers(arrangement, starts, merit)
    return Step((designs.keeping(plan.tolerance),), features, first, done.iterations)


def escapes(specification: Specification, plan: SearchPlan, parents: Designs) -> Step:
    """Take an element out of designs and put one in elsewhere; grow and finish what comes of it."""
    iterations = 0
    by_arrangement: dict[Arrangement, list[tuple[Tensor, Tensor, str]]] = {}
    for fewer in taken_out(parents.arrangement, parents.values):
        less = SearchMerit.of(fewer.arrangement, specification, 3, 6)
        grown = grow(less, fewer.values, plan.stages[-2:-1])
        iterations += grown.iterations
        for more in inserted(fewer.arrangement, grown.values, specification):
            if more.arrangement != Arrangement.of(specification, more.arrangement.stop):
                continue
            if (more.arrangement.stop, 0) not in specification.places_of_stop:
                continue
            of = fewer.parents[grown.starts][more.parents]
            words = f"{fewer.words}, {more.words}"
            by_arrangement.setdefault(more.arrangement, []).append((more.values, of, words))
    found = []
    for arrangement, made in by_arrangement.items():
        merit = SearchMerit.of(arrangement, specification, plan.rings, plan.arms)
        values = torch.cat([part[0] for part in made])
        of = torch.cat([part[1] for part in made])
        all_words = [part[2] for part in made for _ in range(len(part[0]))]
        done = _finished(merit, plan, grow(merit, values, plan.stages[-2:]))
        iterations += done.iterations
        parent = of[done.starts].tolist()
        history = tuple(
            (*parents.history[p], all_words[row])
            for p, row in zip(parent, done.starts.tolist(), strict=True)
        )
        designs = Designs.of(arrangement, done, parents.starts[of[done.starts]], history)
        found.append(designs.keeping(plan.tolerance))
    none = torch.zeros((0, specification.elements), dtype=torch.float64)
    return Step(tuple(found), none, 0, iterations)


def real_glasses(specification: Specification, plan: SearchPlan, form: Designs) -> Step:
    """Give one form catalogue glasses, and finish what comes of it."""
    merit = merit_of(form.arrangement, specification, plan.rings, plan.arms)
    assert isinstance(merit, GlassMerit)  # glasses are chosen
    designs, continuous, iterations = with_real_glasses(
        merit, plan.glass, form, plan.finish_rounds, plan.finish_iterations, plan.tolerance
    )
    none = torch.zeros((0, specification.elements), dtype=torch.float64)
    return Step((designs,), none, 0, iterations, continuous)


def search(specification: Specification, plan: SearchPlan, map_tasks: TaskMap) -> Iterator[Step]:
    """Search, and yield what each task found as soon as it is known.

    Args:
        specification: of the lens.
        plan: how much.
        map_tasks: runs the tasks.
    """
    pool: dict[Arrangement, Designs] = {}
    grown = partial(grown_starts, specification, plan)
    for step in map_tasks(grown, start_tasks(specification, plan), "batches of starts"):
        pool = with_step(pool, step, specification, plan)
        yield step
    if specification.glass_choice is not None:
        best = best_forms(pool, plan.glass.forms)
        snapped = partial(real_glasses, specification, plan)
        yield from map_tasks(snapped, best, "forms whose glasses become real")
        return
    if len(set(specification.element_glasses)) > 1 or specification.elements < 2:
        # An element that is taken out takes its glass with it.
        return
    tried: dict[Arrangement, Tensor] = {}
    for number in range(plan.escapes):
        parents = parents_of(pool, plan.parents, tried)
        if not parents:
            return
        tasks = [part for group in parents for part in shares(group)]
        name = f"escapes of round {number + 1}"
        for step in map_tasks(partial(escapes, specification, plan), tasks, name):
            pool = with_step(pool, step, specification, plan)
            yield step


def with_step(
    pool: dict[Arrangement, Designs],
    step: Step,
    specification: Specification,
    plan: SearchPlan,
) -> dict[Arrangement, Designs]:
    """Return the pool of distinct forms with those of a step."""
    pool = dict(pool)
    for designs in step.designs:
        if not len(designs.values):
            continue
        merit = merit_of(designs.arrangement, specification, plan.rings, plan.arms)
        old = pool.get(designs.arrangement)
        joined = designs if old is None else Designs.joined([old, designs])
        pool[designs.arrangement] = joined.of_distinct_forms(merit, plan.glass.apart)
    return pool


def _finished(merit: SearchMerit, plan: SearchPlan, grown: Grown) -> Grown:
    """Finish the better part of grown lenses."""
    better = grown.best(plan.finished)
    return finish(merit, better, plan.finish_rounds, plan.finish_iterations)
