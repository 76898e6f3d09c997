"""The linear ray model against traced lenses, and its averages against drawn ones."""

from itertools import pairwise

import pytest
import torch

from dolens.tolerancing import (
    Outcome,
    contributions,
    linear_spots,
    scaled_tolerances,
    spot_weights,
    tolerances_from,
    trace_perturbed,
)


def outcomes(triplet, spots, tolerances, count, seed=0):
    weights = spot_weights(None, spots.count)
    errors = tolerances.draw(count, torch.Generator().manual_seed(seed))
    traced = trace_perturbed(triplet, spots, tolerances.names, errors).curves
    linear = linear_spots(triplet, spots, tolerances.names).focus_curves(errors)
    return Outcome.of(traced, weights), Outcome.of(linear, weights)


def test_the_prediction_s_error_falls_with_the_square_of_the_tolerances(triplet, spots, settings):
    wide = tolerances_from(triplet, settings)
    for refocused in (False, True):
        errors = []
        for factor in (0.08, 0.04, 0.02):
            exact, linear = outcomes(triplet, spots, scaled_tolerances(wide, factor), 20)
            pair = (exact.after, linear.after) if refocused else (exact.before, linear.before)
            errors.append(float((pair[0] - pair[1]).norm()))
        for coarse, fine in pairwise(errors):
            assert coarse / fine == pytest.approx(4.0, rel=0.03)


def test_without_errors_the_prediction_is_exact(triplet, spots, settings):
    tolerances = scaled_tolerances(tolerances_from(triplet, settings), 1e-9)
    exact, linear = outcomes(triplet, spots, tolerances, 2)
    torch.testing.assert_close(exact.after, linear.after, rtol=1e-8, atol=0.0)
    torch.testing.assert_close(exact.refocus, linear.refocus, rtol=0.0, atol=1e-8)


def test_average_rise_and_spread_are_those_of_drawn_lenses(triplet, spots, settings):
    """Within four standard errors of 4000 lenses; every tolerance alone, and all together."""
    tolerances, weights = tolerances_from(triplet, settings), spot_weights(None, spots.count)
    model = linear_spots(triplet, spots, tolerances.names)
    count = 4000
    errors = tolerances.draw(count, torch.Generator().manual_seed(7))
    for refocused in (False, True):
        found = contributions(model, tolerances, weights, refocused)

        def mean_squares(errors, refocused=refocused):
            curves = model.focus_curves(errors)
            return curves.at(curves.best_focus(weights) if refocused else 0.0) @ weights

        for column in range(0, len(tolerances.names), 3):
            alone = torch.zeros_like(errors)
            alone[:, column] = errors[:, column]
            rise = mean_squares(alone) - found.nominal
            spread = float(found.spread[column])
            assert float(rise.mean()) == pytest.approx(
                float(found.increase[column]), abs=4.0 * spread / count**0.5
            )
            assert float(rise.std()) == pytest.approx(spread, rel=0.08)
        squares = mean_squares(errors)
        assert found.expected_rms**2 == pytest.approx(
            float(squares.mean()), abs=4.0 * float(squares.std()) / count**0.5
        )
        assert float(found.share.sum()) == pytest.approx(1.0)
        rises = found.increase[found.order].tolist()
        assert rises == sorted(rises, reverse=True)


def test_a_focus_error_costs_nothing_where_it_is_compensated(triplet, spots):
    tolerances = tolerances_from(triplet, {"sensor_distance": 0.1, "thicknesses.2": 0.02})
    model = linear_spots(triplet, spots, tolerances.names)
    column = tolerances.names.index("sensor_distance")
    weights = spot_weights(None, spots.count)
    fixed, free = (contributions(model, tolerances, weights, r) for r in (False, True))
    assert float(fixed.increase[column]) > float(free.increase[1 - column])
    assert float(free.increase[column]) == pytest.approx(0.0, abs=1e-15)
