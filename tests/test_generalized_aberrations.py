"""The residuals of a loss have its value and its gradient, wherever the points wanted are put."""

import pytest
import torch

from scripts.co_design.cases import CASES, METHODS, THEIRS
from scripts.co_design.generalized_aberrations import GeneralizedAberrations, residuals
from scripts.co_design.results import against
from scripts.co_design.training import Trainings, _fit, _steps


def test_half_the_sum_of_squares_is_the_loss_and_its_gradient_the_loss_s():
    generator = torch.Generator().manual_seed(1)
    points = [torch.randn(2, 7, generator=generator), torch.randn(2, 3, generator=generator)]
    gradients = [torch.randn(2, 7, generator=generator), torch.randn(2, 3, generator=generator)]
    factor, pulls = residuals(0.4, points, gradients, [1e3, 1e3])
    square = sum(float(g.square().sum()) for g in gradients)
    assert factor == pytest.approx(square / 0.8)
    for pull, gradient in zip(pulls, gradients, strict=True):
        torch.testing.assert_close(pull, gradient)
    # ½|w(p - p')|², from w²(p - p').
    assert sum(float(p.square().sum()) for p in pulls) / factor / 2.0 == pytest.approx(0.4)


def test_points_beyond_the_window_are_put_on_its_edge_at_the_same_value():
    points, gradient = torch.tensor([[0.0, 0.5]]), torch.tensor([[1e-3, -2e-3]])
    factor, (pull,) = residuals(1.0, [points], [gradient], [2.0])
    torch.testing.assert_close(pull / factor, torch.tensor([[2.0, -1.5]]))
    assert float(pull.square().sum()) / factor / 2.0 == pytest.approx(1.0)


def test_a_lens_moves_by_these_residuals():
    case, method = CASES["Cooke triplet, field"], METHODS[THEIRS]
    trainings = Trainings(["data=photos"], 1.0)
    overrides = [o for o in case.overrides if not o.startswith("~data")]
    overrides += [*method.overrides(case), "optimizer.until=1.0"]
    module, data, _ = trainings._made([*overrides, *_steps(3)], 0)
    before = module.variables.scaled.detach().clone()
    callback = GeneralizedAberrations(tolerance=1e3)
    _fit(module, data, 3, [callback])
    assert callback.taken == 3
    assert bool((module.variables.scaled != before).all())
    assert module.lens_steps.least_squares.taken == 0


def test_the_best_of_ours_counts_against_theirs():
    scores = {
        ("a", 1): (20.0, 21.0, 19.0),
        ("a", 2): (20.0, 19.5, 19.0),
        ("b", 1): (30.0, 1.0, 30.0),
    }
    runs = [
        {"case": case, "seed": seed, "optimizer": o, "score": s, "seconds": 12.0}
        for (case, seed), found in scores.items()
        for o, s in zip((THEIRS, "adam", "least squares"), found, strict=True)
    ]
    lines = against(runs, THEIRS)
    assert "| a | 20.00 | 20.25 | 19.00 | +1.00, -0.50 |" in lines
    assert lines[-1].startswith("The best of ours is at least as good in 2 of 3, by +0.00 dB")
