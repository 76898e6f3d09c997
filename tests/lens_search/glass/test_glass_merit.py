"""The merit of a search with glasses as variables: a triplet, and what snapping leaves of it."""

import pytest
import torch

from dolens import InputError
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.glass.choice import GlassChoice, choose_glasses
from dolens.lens_search.glass.designs import GlassTrials
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.glass_set import glass_set
from dolens.lens_search.glass.reoptimisation import reoptimiser
from dolens.lens_search.glass.snapping import snap_glasses
from dolens.lens_search.glass.trial_glasses import SnapSettings
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.specification import Limits, Specification

LINES = (486.1327, 587.5618, 656.2725)
# The Cooke triplet of the supplement, its stop 0.7 mm in front of the fourth surface.
RADII = (22.014, -435.76, -22.213, 20.292, 79.684, -18.395)
GAPS = (3.259, 6.008, 1.0, 0.7, 4.05, 2.952)
FOCAL, IMAGE = 50.0, 42.2
GLASSES = ("SCHOTT:N-SK16", "SCHOTT:F2", "SCHOTT:N-SK16")


@pytest.fixture(scope="module")
def merit():
    specification = Specification(
        *(FOCAL, 4.9, (0.0, 14.0, 20.0), LINES, (1, 1, 1), GLASSES, (2,), LINES[1]),
        Limits(distortion=0.02, glass=(1.0, 10.0)),
    )
    base = SearchMerit.of(Arrangement((1, 1, 1), 2), specification, 2, 4)
    chosen = choose_glasses(GlassChoice(("SCHOTT",), without=("IRG*",)))
    return GlassMerit(base, glass_set(chosen.glasses, LINES, apart=0.02))


@pytest.fixture(scope="module")
def lenses():
    row = [FOCAL / r for r in RADII] + [g / FOCAL for g in GAPS] + [IMAGE / FOCAL]
    scatter = torch.randn(2, len(row), generator=torch.Generator().manual_seed(0)).double()
    scatter[0] = 0.0
    return torch.tensor(row, dtype=torch.float64) * (1.0 + 0.003 * scatter)


@pytest.fixture(scope="module")
def numbers(merit):
    return torch.tensor([[merit.glasses.names.index(name) for name in GLASSES]] * 2)


def with_glasses(merit, lenses, numbers):
    return torch.cat([lenses, merit.glasses.coordinates[numbers].flatten(1)], 1)


def test_real_glasses_give_the_merit_without_glasses(merit, lenses, numbers):
    u, full = with_glasses(merit, lenses, numbers), merit.base.full(2)
    mine, base = merit.optical(u, numbers, full), merit.base.evaluate(lenses, full)
    count = lenses.shape[1]
    torch.testing.assert_close(mine.merit, base.merit, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(mine.gradient[:, :count], base.gradient)
    torch.testing.assert_close(mine.hessian[:, :count, :count], base.hessian)
    torch.testing.assert_close(merit.spots(u, numbers, full), merit.base.spots(lenses, full))


def test_derivatives_with_respect_to_lens_and_glasses(merit, lenses, numbers):
    full = merit.base.full(2)
    free = torch.full_like(numbers, -1)
    # The second lens's glasses are outside of the region, where walls push.
    u = with_glasses(merit, lenses, numbers)
    u[1, lenses.shape[1] :] += 0.1
    u[1, -3] += 6.0
    model = merit.evaluate(u, free, full)
    assert merit.evaluate(u, free, full).merit[1] > merit.optical(u, free, full).merit[1]
    for column in range(u.shape[1]):
        step = torch.zeros_like(u)
        step[:, column] = 1e-6
        ends = [merit.optical(u + side * step, free, full).merit for side in (1.0, -1.0)]
        walls = [merit.evaluate(u + side * step, free, full).merit for side in (1.0, -1.0)]
        scale = model.gradient.abs().amax(1)
        optical = merit.optical(u, free, full).gradient[:, column]
        torch.testing.assert_close(
            (ends[0] - ends[1]) / 4e-6 / scale, optical / scale, atol=2e-6, rtol=0.0
        )
        # The first lens's flint lies on the edge of the region, where walls have no derivative.
        slope = (walls[0] - walls[1])[1] / 4e-6
        torch.testing.assert_close(
            slope / scale[1], model.gradient[1, column] / scale[1], atol=2e-6, rtol=0.0
        )


def test_a_triplet_gains_from_free_glasses_and_keeps_it_with_real_ones(merit, lenses, numbers):
    full = merit.base.full(1)
    optimise = reoptimiser(merit, full, 40, 1e-5)
    start = GlassTrials(
        torch.tensor([0]), lenses[:1], merit.glasses.coordinates[numbers[:1]], numbers[:1]
    )
    before = optimise(start).merit
    free = start._replace(numbers=torch.full_like(numbers[:1], -1))
    settings = SnapSettings(neighbours=3, far=0, beam=1, pair_neighbours=0, rounds=0)
    found = snap_glasses(free, merit.glasses.coordinates, optimise, settings)
    assert (found.designs.trials.numbers >= 0).all()
    assert found.designs.merit < 0.7 * before
    # What the callback says is what the lens of these glasses gives.
    trials = found.designs.trials
    u = torch.cat([trials.variables, trials.coordinates.flatten(1)], 1)
    square = merit.evaluate(u, trials.numbers, full).merit
    torch.testing.assert_close(found.designs.merit.square(), square)


def test_glasses_at_other_wavelengths_are_refused(merit):
    other = glass_set(merit.glasses.glasses[:5], (500.0, 600.0))
    with pytest.raises(InputError, match=r"\[500.0, 600.0\] nm"):
        GlassMerit(merit.base, other)
