"""Many least-squares problems at once end where each would alone."""

import pytest
import torch

from dolens.errors import InputError
from dolens.optimize import DampedLeastSquares
from dolens.optimize.batch_least_squares import (
    BatchModel,
    Ended,
    bounded_steps,
    bounded_steps_by_torch,
    minimise_batch,
    predicted_gain,
)


def rosenbrock(which, u):
    """Return residuals 10(v - u²) and 1 - u, each problem with a valley of its own steepness."""
    steep = (10.0 + which.double())[:, None]
    x, y = u.unbind(-1)
    residual = torch.stack([steep[:, 0] * (y - x * x), 1.0 - x], -1)
    jacobian = torch.zeros(len(u), 2, 2, dtype=torch.float64)
    jacobian[:, 0, 0], jacobian[:, 0, 1] = -2.0 * steep[:, 0] * x, steep[:, 0]
    jacobian[:, 1, 0] = -1.0
    return BatchModel(
        residual.square().sum(-1),
        torch.einsum("nr,nrp->np", residual, jacobian),
        jacobian.mT @ jacobian,
    )


STARTS = torch.tensor([[-1.2, 1.0], [3.0, -2.0], [0.0, 5.0], [1.0, 1.0]], dtype=torch.float64)
FREE = torch.full((2,), torch.inf, dtype=torch.float64)


def test_rosenbrock_valleys_are_followed_to_their_ends():
    found = minimise_batch(rosenbrock, STARTS, -FREE, FREE, 200, 1e-14)
    torch.testing.assert_close(found.values, torch.ones_like(STARTS), rtol=0.0, atol=1e-6)
    # The last one stands at its minimum and takes no step.
    assert int(found.iterations[3]) <= 1


def test_a_problem_ends_where_it_would_without_the_others():
    together = minimise_batch(rosenbrock, STARTS, -FREE, FREE, 7, 1e-12)
    for row in range(len(STARTS)):

        def alone(which, u, row=row):
            return rosenbrock(which + row, u)

        one = minimise_batch(alone, STARTS[row : row + 1], -FREE, FREE, 7, 1e-12)
        torch.testing.assert_close(together.values[row], one.values[0], rtol=1e-12, atol=1e-12)


def test_bounds_stop_it_where_the_single_solver_stops():
    upper = torch.tensor([0.5, 10.0], dtype=torch.float64)
    found = minimise_batch(rosenbrock, STARTS[:1], -FREE, upper, 200, 1e-14)
    variable = STARTS[0].clone().requires_grad_()
    single = DampedLeastSquares([{"params": [variable], "upper": upper}])

    def closure():
        x, y = variable
        return torch.stack([10.0 * (y - x * x), 1.0 - x])

    for _ in range(200):
        single.step(closure)
    # By hand: u = 1/2 and v = u².
    torch.testing.assert_close(
        found.values[0], torch.tensor([0.5, 0.25], dtype=torch.float64), rtol=0.0, atol=1e-7
    )
    torch.testing.assert_close(found.values[0], variable.detach(), rtol=0.0, atol=1e-7)


def test_a_problem_that_cannot_be_evaluated_leaves_the_others_alone():
    def some_fail(which, u):
        model = rosenbrock(which, u)
        return BatchModel(
            torch.where(which == 1, torch.inf, model.merit), model.gradient, model.hessian
        )

    found = minimise_batch(some_fail, STARTS, -FREE, FREE, 200, 1e-14)
    assert int(found.ended[1]) == Ended.NO_START
    assert torch.equal(found.values[1], STARTS[1])
    torch.testing.assert_close(found.values[0], torch.ones(2, dtype=torch.float64))


def test_trials_where_it_cannot_be_evaluated_are_refused():
    def walled(which, u):
        model = rosenbrock(which, u)
        beyond = u[:, 0] > 0.8
        return BatchModel(
            torch.where(beyond, torch.inf, model.merit), model.gradient, model.hessian
        )

    found = minimise_batch(walled, STARTS[:1], -FREE, FREE, 300, 1e-14)
    assert 0.75 < float(found.values[0, 0]) <= 0.8


@pytest.mark.parametrize("steps", [bounded_steps, bounded_steps_by_torch])
@pytest.mark.parametrize(("seed", "size"), [(0, 5), (1, 5), (2, 1), (3, 41)])
def test_a_bounded_step_is_the_minimum_of_its_model_in_the_box(seed, size, steps):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(50, size + 1, size, generator=generator, dtype=torch.float64)
    gradient = torch.randn(50, size, generator=generator, dtype=torch.float64)
    model = BatchModel(torch.full((50,), 10.0).double(), gradient, root.mT @ root)
    damping = torch.full((50, size), 0.1, dtype=torch.float64)
    lower = -0.3 * torch.rand(50, size, generator=generator, dtype=torch.float64)
    upper = 0.3 * torch.rand(50, size, generator=generator, dtype=torch.float64)
    step = steps(model, damping, lower, upper)
    assert bool(((step >= lower) & (step <= upper)).all())
    slope = torch.einsum("npq,nq->np", model.hessian + torch.diag_embed(damping), step) + gradient
    # Kuhn and Tucker: no slope where free, and one that presses outwards on a bound.
    free = (step > lower) & (step < upper)
    assert float(torch.where(free, slope, 0.0).abs().max()) < 1e-9
    assert bool(((step > lower) | (slope >= -1e-9)).all())
    assert bool(((step < upper) | (slope <= 1e-9)).all())
    assert bool((~free).any(-1).double().mean() > 0.5)
    assert bool((predicted_gain(model, step) > 0.0).all())


def test_bounds_that_exclude_each_other_are_named():
    lower = torch.tensor([0.0, 2.0], dtype=torch.float64)
    upper = torch.tensor([1.0, 1.0], dtype=torch.float64)
    with pytest.raises(InputError, match="problem 0, variable 1: lower bound 2 exceeds upper 1"):
        minimise_batch(rosenbrock, STARTS, lower, upper, 5)
