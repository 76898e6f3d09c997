"""A search finds the forms that optics knows, from nothing."""

import pytest
import torch

from dolens.lens_search.growth import Stage
from dolens.lens_search.search import SearchPlan, grown_starts, search, start_tasks, with_step
from dolens.lens_search.specification import Limits, Specification
from dolens.tasks import in_turn


def best_of(specification, plan):
    pool = {}
    for step in search(specification, plan, in_turn):
        pool = with_step(pool, step, specification, plan)
    return min(pool.values(), key=lambda designs: float(designs.merit.min()))


def test_a_singlet_takes_the_bending_of_least_spherical_aberration():
    """A thin lens of index n: q = 2(n² - 1)/(n + 2) (Welford, ch. 12)."""
    n = 1.5
    specification = Specification(
        focal_length=100.0,
        f_number=12.0,
        fields=(0.0,),
        wavelengths=(587.5618,),
        groups=(1,),
        glasses=(str(n),),
        stops=(0,),
        limits=Limits(glass=(0.4, 0.41), air=(0.0, 0.01), glass_edge=0.0),
    )
    plan = SearchPlan(starts=20, batch=20, stages=(Stage(iterations=40),), finished=1.0, escapes=0)
    designs = best_of(specification, plan)
    front, back = designs.values[0, :2].tolist()
    assert (front + back) / (front - back) == pytest.approx(
        2.0 * (n * n - 1.0) / (n + 2.0), abs=0.02
    )
    assert float(designs.violation[0]) < 1e-5


TRIPLET = Specification(
    focal_length=50.0,
    f_number=6.0,
    fields=(0.0, 14.0),
    wavelengths=(587.5618,),
    groups=(1, 1),
    glasses=("1.6204/60.31",),
    stops=(0, 1),
    limits=Limits(glass=(1.0, 10.0), air=(0.1, 20.0), back_focus=20.0),
)
SMALL = SearchPlan(starts=24, batch=12, finish_rounds=3, finish_iterations=15, escapes=0)


def test_every_place_of_the_stop_has_starts_and_no_start_is_lost():
    tasks = start_tasks(TRIPLET, SearchPlan(starts=45, batch=10))
    assert {stop for stop, _, _ in tasks} == {(0, 0), (1, 0)}
    assert sum(count for _, _, count in tasks) == 45
    firsts = [first for _, first, _ in tasks]
    assert firsts == sorted(set(firsts))


def test_a_task_depends_on_its_number_alone():
    task = start_tasks(TRIPLET, SMALL)[1]
    one, other = (grown_starts(TRIPLET, SMALL, task) for _ in range(2))
    assert torch.equal(one.designs[0].values, other.designs[0].values)
    assert torch.equal(one.features, other.features)


def test_designs_keep_their_operands_and_forms_are_counted_once():
    pool = {}
    for step in search(TRIPLET, SMALL, in_turn):
        for designs in step.designs:
            assert bool((designs.violation <= SMALL.tolerance).all())
            assert bool(torch.isfinite(designs.spots).all())
        again = with_step(pool, step, TRIPLET, SMALL)
        pool = again
        # The same designs once more are no new forms.
        twice = with_step(pool, step, TRIPLET, SMALL)
        for arrangement, designs in pool.items():
            assert len(twice[arrangement].values) == len(designs.values)
    assert pool
