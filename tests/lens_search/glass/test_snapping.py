"""Continuous glasses become the best real ones, which are known here by trying all."""

import pytest
import torch

from dolens import InputError
from dolens.lens_search.glass.choice import GlassChoice, choose_glasses, glass_set
from dolens.lens_search.glass.glass_step import glass_models, snap_glasses
from dolens.lens_search.glass.trial_glasses import (
    GlassTrials,
    Reoptimised,
    SnapSettings,
    best_of_each_lens,
)
from tests.lens_search.glass import thin_lens_colour as thin

LINES = (656.2725, 587.5618, 546.074, 486.1327, 435.8343)


@pytest.fixture(scope="module")
def glasses():
    chosen = choose_glasses(GlassChoice(("SCHOTT",), names=("N-*",)))
    return glass_set(chosen.glasses, LINES, apart=0.02)


def snapped(*given, **options):
    """The best design of each lens, in the order of their numbers."""
    best = best_of_each_lens(snap_glasses(*given, **options), 1)
    return best.take(best.trials.lens.argsort())


@pytest.mark.parametrize("count", [2, 3])
def test_the_snapped_achromat_and_apochromat_are_within_a_percent_of_the_best(glasses, count):
    best = thin.all_merits(glasses, count)[0].min()
    fixed, found = (
        snapped(
            thin.start(glasses, count, lenses=2, seed=3),
            glasses.coordinates,
            thin.reoptimise(glasses, iterations=25),
            SnapSettings(rounds=rounds),
        )
        for rounds in (0, SnapSettings().rounds)
    )
    numbers = found.trials.numbers
    assert (numbers >= 0).all()
    torch.testing.assert_close(thin.merit(glasses.indices[numbers]), found.merit)
    assert (found.merit < 1.01 * best).all()
    # Exchanges only help.
    assert (found.merit <= fixed.merit).all()


def test_costs_decide_between_glasses_that_are_nearly_as_good(glasses):
    merits, pairs = thin.all_merits(glasses, 2)
    cost = torch.zeros(len(glasses.names)).double()
    cost[pairs[merits.argmin()]] = 0.5
    found = snapped(
        thin.start(glasses, 2, seed=3),
        glasses.coordinates,
        thin.reoptimise(glasses, iterations=25),
        SnapSettings(neighbours=4),
        cost=cost,
    )
    totals = merits + cost[pairs].sum(1)
    assert totals.argmin() != merits.argmin()
    assert found.total[0] < 1.01 * totals.min()
    chosen = found.trials.numbers
    torch.testing.assert_close(found.total, found.merit + cost[chosen].sum(1))


def test_held_glasses_stay(glasses):
    start = thin.start(glasses, 3, seed=1)
    number = glasses.names.index("SCHOTT:N-KZFS11")
    start.numbers[0, 1] = number
    start.coordinates[0, 1] = glasses.coordinates[number]
    calls = []
    found = snapped(
        start,
        glasses.coordinates,
        thin.reoptimise(glasses, calls, iterations=10),
        SnapSettings(neighbours=2, far=4, beam=2, rounds=2),
    )
    assert found.trials.numbers[0, 1] == number
    assert all((trials.numbers[:, 1] == number).all() for trials in calls)


def test_the_glass_that_costs_least_is_fixed_first():
    """Of two glasses on a line of real ones, the one that is between them waits."""
    real = torch.tensor([[0.0], [1.0], [2.0]]).double()
    target = torch.tensor([0.9, 0.4]).double()

    def reoptimise(trials):
        # The second glass makes up for what the first one misses.
        x = trials.coordinates.clone()
        wanted = target.expand(len(x), -1).clone()
        off = torch.where(trials.numbers >= 0, x[..., 0] - wanted, 0.0)
        free = trials.numbers < 0
        shifted = wanted - off.sum(1, keepdim=True)
        x[..., 0] = torch.where(free, shifted, x[..., 0])
        return Reoptimised((x[..., 0] - wanted).sum(1).abs(), trials.variables, x)

    start = GlassTrials(
        torch.tensor([7]), torch.zeros(1, 0), target.reshape(1, 2, 1), torch.full((1, 2), -1)
    )
    found = snapped(start, real, reoptimise, SnapSettings(far=0, rounds=3))
    # 1 + 0 = 1 is nearest to 0.9 + 0.4 = 1.3.
    assert sorted(found.trials.numbers[0].tolist()) == [0, 1]
    assert found.merit.item() == pytest.approx(0.3)
    assert found.trials.lens.tolist() == [7]


def test_a_lens_whose_trials_all_fail_is_not_among_the_results(glasses):
    start = thin.start(glasses, 2, lenses=2)
    good = thin.reoptimise(glasses, iterations=2, modelled=False)

    def reoptimise(trials):
        found = good(trials)
        return found._replace(merit=torch.where(trials.lens == 1, torch.nan, found.merit))

    few = SnapSettings(neighbours=2, far=0, beam=1, rounds=1)
    found = snapped(start, glasses.coordinates, reoptimise, few)
    assert found.trials.lens.tolist() == [0]


def test_the_model_of_a_glass_is_exact_for_linear_residuals():
    generator = torch.Generator().manual_seed(0)
    residuals, variables, glasses, count = 30, 4, 3, 2
    size = variables + glasses * count
    jacobian = torch.randn(2, residuals, size, generator=generator).double()
    right = torch.randn(2, residuals, generator=generator).double()
    free = torch.ones(2, size, dtype=torch.bool)
    free[0, 1] = False  # a variable that is held
    free[1, variables:] = False  # glasses that are held
    gram = jacobian.transpose(1, 2) @ jacobian
    gradient = (jacobian.transpose(1, 2) @ right[..., None])[..., 0]
    model = glass_models(gram, gradient, free, (glasses, count))
    move = torch.tensor([0.3, -0.2]).double()
    for lens in range(2):
        for glass in range(glasses):
            columns = torch.arange(size)
            own = (columns >= variables + glass * count) & (
                columns < variables + (glass + 1) * count
            )
            others = jacobian[lens][:, free[lens] & ~own]

            def least(target, others=others):
                step = torch.linalg.lstsq(others, -target[:, None]).solution
                return (target + (others @ step)[:, 0]).square().sum()

            there = least(right[lens] + jacobian[lens][:, own] @ move)
            slope, curvature = model.slopes[lens, glass], model.curvatures[lens, glass]
            expected = 2.0 * slope @ move + move @ curvature @ move
            torch.testing.assert_close(expected, there - least(right[lens]))


def test_what_is_wrong_is_said(glasses):
    start = thin.start(glasses, 2, lenses=2)
    with pytest.raises(InputError, match="no glass to choose from"):
        snap_glasses(start, glasses.coordinates[:0], thin.reoptimise(glasses))
    same = start._replace(lens=torch.zeros(2, dtype=torch.long))
    with pytest.raises(InputError, match="same number"):
        snap_glasses(same, glasses.coordinates, thin.reoptimise(glasses))
    with pytest.raises(InputError, match="beam must be at least 1"):
        SnapSettings(beam=0)
