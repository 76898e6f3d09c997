"""The merit of a search with glasses as variables: a triplet, and what snapping leaves of it."""

from dataclasses import replace

import pytest
import torch

from dolens import InputError
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.glass.choice import GlassChoice, choose_glasses, glass_set
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.glass_step import reoptimiser, snap_glasses
from dolens.lens_search.glass.trial_glasses import GlassTrials, SnapSettings
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.real_pupils import with_real_beams
from dolens.lens_search.search_rays import search_rays
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
    chosen = choose_glasses(GlassChoice(("SCHOTT",), without=("IRG*",)))
    glasses = glass_set(chosen.glasses, LINES, apart=0.02)
    rays = search_rays(specification, 2, 4)
    return GlassMerit(Arrangement((1, 1, 1), 2), specification, rays, glasses=glasses)


@pytest.fixture(scope="module")
def base(merit):
    """The merit of lenses with the glasses of the specification."""
    return SearchMerit(merit.arrangement, merit.specification, merit.rays)


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
    return merit.with_glasses(lenses, merit.glasses.coordinates[numbers.clamp(min=0)], numbers)


def test_real_glasses_give_the_merit_without_glasses(merit, base, lenses, numbers):
    u, full = with_glasses(merit, lenses, numbers), merit.full(2)
    without = base.evaluate(lenses, full)
    count = lenses.shape[1]
    for mine in (merit.optical(u, full), merit.held().evaluate(u, full)):
        torch.testing.assert_close(mine.merit, without.merit, rtol=1e-12, atol=0.0)
        torch.testing.assert_close(mine.gradient[:, :count], without.gradient)
        torch.testing.assert_close(mine.hessian[:, :count, :count], without.hessian)
    torch.testing.assert_close(merit.spots(u, full), base.spots(lenses, full))
    real, given = (with_real_beams(m, v, full) for m, v in ((merit, u), (base, lenses)))
    torch.testing.assert_close(real.pupils, given.pupils)


def test_derivatives_with_respect_to_lens_and_glasses(merit, lenses, numbers):
    full = merit.full(2)
    # The second lens's glasses are outside of the region, where walls push.
    u = merit.freed(with_glasses(merit, lenses, numbers))
    last = u.shape[1] - numbers.shape[1]
    u[1, lenses.shape[1] : last] += 0.1
    u[1, last - 3] += 6.0
    model = merit.evaluate(u, full)
    assert model.merit[1] > merit.optical(u, full).merit[1]
    for column in range(last):
        step = torch.zeros_like(u)
        step[:, column] = 1e-6
        ends = [merit.optical(u + side * step, full).merit for side in (1.0, -1.0)]
        walls = [merit.evaluate(u + side * step, full).merit for side in (1.0, -1.0)]
        scale = model.gradient.abs().amax(1)
        optical = merit.optical(u, full).gradient[:, column]
        torch.testing.assert_close(
            (ends[0] - ends[1]) / 4e-6 / scale, optical / scale, atol=2e-6, rtol=0.0
        )
        # The first lens's flint lies on the edge of the region, where walls have no derivative.
        slope = (walls[0] - walls[1])[1] / 4e-6
        torch.testing.assert_close(
            slope / scale[1], model.gradient[1, column] / scale[1], atol=2e-6, rtol=0.0
        )


def test_a_triplet_gains_from_free_glasses_and_keeps_it_with_real_ones(merit, lenses, numbers):
    full = merit.full(1)
    optimise = reoptimiser(merit, full, 40, 1e-5)
    start = GlassTrials(
        torch.tensor([0]), lenses[:1], merit.glasses.coordinates[numbers[:1]], numbers[:1]
    )
    before = optimise(start).merit
    free = start._replace(numbers=torch.full_like(numbers[:1], -1))
    settings = SnapSettings(neighbours=3, far=0, beam=1, pair_neighbours=0, rounds=0)
    found = snap_glasses(free, merit.glasses.coordinates, optimise, settings)
    assert (found.trials.numbers >= 0).all()
    assert found.merit < 0.7 * before
    # What the callback says is the mean of the spots that the lens of these glasses has, and what
    # its operands lack.
    trials = found.trials
    u = merit.with_glasses(trials.variables, trials.coordinates, trials.numbers)
    mean = merit.spots(u, full).mean(1) / FOCAL
    lacking = (found.merit - mean) / mean
    assert 0.0 <= lacking < 0.1


def test_cemented_glasses_are_told_apart():
    """A doublet of N-BK7 and N-SF5, which a family's own lens must not take for one glass."""
    names = ("SCHOTT:N-BK7", "SCHOTT:N-SF5")
    specification = Specification(100.0, 6.0, (0.0, 1.0), LINES, (2,), names, (0,))
    chosen = choose_glasses(GlassChoice(("SCHOTT",), names=("N-BK7", "N-SF5", "N-F2", "F2")))
    base = SearchMerit.of(Arrangement((2,), 0), specification, 2, 4)
    glasses = glass_set(chosen.glasses, LINES)
    merit = GlassMerit(base.arrangement, specification, base.rays, glasses=glasses)
    lens = torch.tensor([[1.6124, -2.3768, -0.8339, 0.01, 0.12, 0.0683, 0.9141]]).double()
    numbers = torch.tensor([[glasses.names.index(name) for name in names]])
    u = with_glasses(merit, lens, numbers)
    torch.testing.assert_close(merit.spots(u, merit.full(1)), base.spots(lens, base.full(1)))


def test_glasses_at_other_wavelengths_are_refused(merit):
    other = glass_set(merit.glasses.glasses[:5], (500.0, 600.0))
    with pytest.raises(InputError, match=r"\[500.0, 600.0\] nm"):
        replace(merit, glasses=other)
