"""The co-designs on which optimizers of a lens are compared, and the tables of their gains.

The residuals of a loss have its value and its gradient, wherever the points wanted are put.
"""

import pytest
import torch

from dolens.rendering.psf_grid import _watch
from scripts.co_design.cases import CASES, METHODS, THEIRS, candidates
from scripts.co_design.generalized_aberrations import GeneralizedAberrations, residuals
from scripts.co_design.results import against, gains, summary, table
from scripts.co_design.training import Trainings, _fit, _steps


def module_of(case, *more):
    """The camera of a case with the installed photographs, and what else its training takes."""
    overrides = [o for o in case.overrides if not o.startswith("~data")]
    return Trainings(["data=photos"], 1.0)._made([*overrides, *more], 0)


@pytest.mark.parametrize("name", CASES)
def test_a_co_design_composes_and_its_lens_moves(name):
    """Its variables are those of the lens, and both optimizers take four settings."""
    case = CASES[name]
    found = candidates(case)
    assert {key: len(settings) for key, settings in found.items()} == {
        "adam": 4,
        "least squares": 4,
    }
    module, _, score = module_of(case, *found["least squares"][1])
    assert len(module.variables) >= 4
    assert module.lens_steps.apart
    assert score.startswith("psnr_db")


def runs(scores: dict[str, dict[str, list[float]]]) -> list[dict[str, object]]:
    return [
        {"case": case, "optimizer": o, "seed": n, "score": s, "steps": 10.0, "seconds": 12.0}
        for case, of_case in scores.items()
        for o, found in of_case.items()
        for n, s in enumerate(found)
    ]


def test_gains_are_paired_by_seed():
    found = runs(
        {
            "a": {"adam": [20.0, 22.0], "least squares": [21.0, 22.5]},
            "b": {"adam": [30.0, 30.0], "least squares": [29.9, 30.3]},
        }
    )
    by_case = gains(found)
    assert by_case["a"] == pytest.approx([1.0, 0.5])
    assert by_case["b"] == pytest.approx([-0.1, 0.3])
    assert summary(by_case).startswith("Least squares win 3 of 4, median +0.40 dB [")
    lines = table(found)
    assert "| a | 21.00 | 21.75 | +1.00, +0.50 | 10, 10 | 12.0, 12.0 |" in lines


def test_a_gain_that_all_have_is_certain():
    scores = {name: {"adam": [20.0], "least squares": [20.5]} for name in "abc"}
    assert "median +0.50 dB [+0.50, +0.50]" in summary(gains(runs(scores)))


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
    overrides = [*method.overrides(case), "optimizer.until=1.0"]
    module, data, _ = module_of(case, *overrides, *_steps(3))
    before = module.variables.scaled.detach().clone()
    callback = GeneralizedAberrations(tolerance=1e3)
    _fit(module, data, 3, [callback])
    assert callback.taken == 3
    assert bool((module.variables.scaled != before).all())
    assert module.lens_steps.least_squares.taken == 0


def test_a_training_that_fails_leaves_nothing_watched_and_another_can_follow():
    callback, module = GeneralizedAberrations(), torch.nn.Module()
    for end in (
        lambda: callback.on_exception(None, module, KeyboardInterrupt()),
        lambda: callback.on_train_end(None, module),
    ):
        callback.on_train_start(None, module)
        assert "backward" in vars(module) and _watch.get() == callback._cut
        end()
        assert "backward" not in vars(module) and _watch.get() is None
    # It may fail before it begins.
    GeneralizedAberrations().on_exception(None, module, ValueError())


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
