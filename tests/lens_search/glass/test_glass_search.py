"""A search that chooses glasses finds the pair that closed forms say is best."""

import math

import pytest
import torch

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.glass.choice import GlassChoice, chosen_glasses
from dolens.lens_search.glass.glass_family import FREE
from dolens.lens_search.glass.glass_merit import GlassMerit, merit_of
from dolens.lens_search.glass.glass_step import GlassPlan
from dolens.lens_search.glass.thin_achromats import best_achromats
from dolens.lens_search.glass.trial_glasses import SnapSettings
from dolens.lens_search.growth import grow
from dolens.lens_search.search import SearchPlan, Stage, search, with_step
from dolens.lens_search.specification import Limits, Specification
from dolens.lens_search.starts import random_starts
from dolens.tasks import in_turn

LINES = (656.2725, 587.5618, 486.1327)
# Old achromats are N-BK7 with F2; a fluor crown with a short flint has a tenth of their colour.
NAMES = ("N-BK7", "N-SK16", "F2", "SF5", "N-FK51A", "N-KZFS4", "N-LAF2", "N-SF6")
OBJECTIVE = Specification(
    focal_length=100.0,
    f_number=8.0,
    fields=(0.0, 0.5),
    wavelengths=LINES,
    groups=(2,),
    glasses=(),
    stops=(0,),
    glass_choice=GlassChoice(("SCHOTT",), names=NAMES),
    limits=Limits(glass=(2.0, 10.0), air=(0.0, 1.0), track=130.0),
)
PLAN = SearchPlan(
    starts=24,
    batch=24,
    stages=(Stage(1.0, 1.0, iterations=30, kept=0.3),),
    finish_rounds=3,
    finish_iterations=20,
    rings=2,
    arms=4,
    glass=GlassPlan(forms=2, snapping=SnapSettings(far=8, neighbours=3, rounds=2), rings=2, arms=4),
)


@pytest.fixture(scope="module")
def found():
    pool, losses = {}, []
    for step in search(OBJECTIVE, PLAN, in_turn):
        pool = with_step(pool, step, OBJECTIVE, PLAN)
        if step.continuous is not None and len(step.designs[0].values):
            losses.append(float(step.designs[0].merit[0]) / step.continuous - 1.0)
    best = min(pool.values(), key=lambda designs: float(designs.merit.min()))
    return best.chosen(best.merit.argmin()[None]), losses


def test_the_best_pair_is_that_of_least_secondary_spectrum(found):
    best, _ = found
    merit = merit_of(best.arrangement, OBJECTIVE, 2, 4)
    assert isinstance(merit, GlassMerit)
    (names,) = merit.names(best.values)
    glasses = chosen_glasses(OBJECTIVE.glass_choice, LINES)
    pairs = best_achromats(glasses.indices, 100.0, 8.0, count=1).glasses[0].tolist()
    assert sorted(names) == sorted(glasses.names[n] for n in pairs)
    assert set(names) == {"SCHOTT:N-FK51A", "SCHOTT:N-KZFS4"}


def test_a_lens_is_written_with_the_indices_of_the_catalogue(found):
    """The focal length of the lens in its glasses is that of the specification."""
    best, _ = found
    merit = merit_of(best.arrangement, OBJECTIVE, 2, 4)
    power, *_ = merit.paraxial_of(best.values)
    assert float(power) == pytest.approx(1.0, abs=PLAN.tolerance)
    assert bool(merit.are_real(best.values).all())


def test_what_real_glasses_cost_is_a_number(found):
    _, losses = found
    assert losses and all(math.isfinite(loss) and loss > -0.5 for loss in losses)
    assert torch.tensor(losses).min() < 0.2


def test_rounding_does_not_choose_the_way_of_a_descent():
    """Starts meet their focal length to the last digit, in glasses on walls of the region."""
    arrangement = Arrangement.of(OBJECTIVE, *OBJECTIVE.places_of_stop[0])
    merit = merit_of(arrangement, OBJECTIVE, 3, 6)
    generator = torch.Generator().manual_seed(0)
    starts = random_starts(merit, 24, generator)
    noise = 1e-14 * torch.randn(starts.shape, generator=generator, dtype=torch.float64)
    rounded = torch.where(starts == FREE, starts, starts * (1.0 + noise))
    stage = (Stage(1.0, 1.0, iterations=10),)
    one, other = (grow(merit, values, stage) for values in (starts, rounded))
    torch.testing.assert_close(one.values, other.values, rtol=0.0, atol=1e-7)
