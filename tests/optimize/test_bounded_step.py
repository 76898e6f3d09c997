"""The damped step within bounds, against its optimality conditions and SciPy."""

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear

from dolens.optimize.linear_least_squares import (
    LinearModel,
    bounded_step,
    damped_step,
    projected_step,
)

INFINITE = float("inf")


def model_of(rows, columns, seed, condition=1e3):
    generator = torch.Generator().manual_seed(seed)
    jacobian = torch.randn(rows, columns, generator=generator, dtype=torch.float64)
    scales = torch.logspace(0.0, np.log10(condition), columns, dtype=torch.float64)
    residuals = torch.randn(rows, generator=generator, dtype=torch.float64)
    return jacobian * scales, residuals, LinearModel.of_rows(residuals, jacobian * scales)


def box(columns, seed):
    """Bounds some of which bind: on the variable itself, near, far or absent."""
    generator = torch.Generator().manual_seed(1000 + seed)
    sizes = torch.tensor([0.0, 1e-4, 1e-2, 1.0, INFINITE], dtype=torch.float64)
    lower, upper = (sizes[torch.randint(5, (columns,), generator=generator)] for _ in range(2))
    return -lower, upper


def test_without_bounds_it_solves_the_damped_normal_equations():
    jacobian, residuals, model = model_of(40, 6, 0)
    damping = torch.full((6,), 0.3, dtype=torch.float64)
    step = damped_step(model, damping)
    matrix = jacobian.T @ jacobian + torch.diag(damping)
    expected = torch.linalg.solve(matrix, -jacobian.T @ residuals)
    assert torch.allclose(step, expected, rtol=1e-9)


@pytest.mark.parametrize("columns", [1, 2, 5, 30, 120])
@pytest.mark.parametrize("seed", range(6))
def test_the_step_is_the_minimum_within_the_box(columns, seed):
    """Karush, Kuhn and Tucker: no free variable has a slope, no held one wants to come back."""
    jacobian, residuals, model = model_of(2 * columns + 3, columns, seed)
    lower, upper = box(columns, seed)
    damping = 1e-3 * model.column_norms.square()
    step, active = bounded_step(model, damping, lower, upper)
    assert bool(((step >= lower) & (step <= upper)).all())
    slope = jacobian.T @ (residuals + jacobian @ step) + damping * step
    scale = model.column_norms * residuals.norm()
    free = active == 0
    assert float((slope / scale)[free].abs().amax()) < 1e-10 if bool(free.any()) else True
    pinned = lower == upper
    assert bool((slope[(active < 0) & ~pinned] >= -1e-10 * scale[(active < 0) & ~pinned]).all())
    assert bool((slope[(active > 0) & ~pinned] <= 1e-10 * scale[(active > 0) & ~pinned]).all())
    assert torch.equal(step[active < 0], lower[active < 0])
    assert torch.equal(step[active > 0], upper[active > 0])


@pytest.mark.parametrize("seed", range(4))
def test_scipy_finds_the_same_minimum(seed):
    jacobian, residuals, model = model_of(30, 8, seed, condition=10.0)
    lower, upper = box(8, seed)
    upper = torch.where(upper == lower, upper + 1e-3, upper)  # SciPy wants room
    damping = torch.full((8,), 0.1, dtype=torch.float64)
    rows = torch.cat([jacobian, torch.diag(damping.sqrt())]).numpy()
    right = -torch.cat([residuals, torch.zeros(8, dtype=torch.float64)]).numpy()
    expected = lsq_linear(rows, right, (lower.numpy(), upper.numpy()), method="bvls", tol=1e-14)
    step, _ = bounded_step(model, damping, lower, upper)
    assert np.allclose(step.numpy(), expected.x, rtol=1e-8, atol=1e-12)


def test_all_bounds_active_and_all_variables_pinned():
    _, _, model = model_of(20, 5, 3)
    damping, zero = torch.full((5,), 1e-6, dtype=torch.float64), torch.zeros(5).double()
    step, active = bounded_step(model, damping, zero, zero)
    assert torch.equal(step, zero) and bool((active != 0).all())
    tiny = torch.full((5,), 1e-9, dtype=torch.float64)
    step, active = bounded_step(model, damping, -tiny, tiny)
    assert torch.equal(step.abs(), tiny) and bool((active != 0).all())
    assert torch.equal(step.sign(), -model.gradient.sign())


def test_every_corner_of_three_variables_is_tried_by_hand():
    """The least of all 27 choices of lower, free and upper that stay within the box."""
    _, _, model = model_of(9, 3, 8, condition=30.0)
    lower, upper = (
        torch.tensor([-0.01, -0.2, -0.001]).double(),
        torch.tensor([0.02, 0.01, 0.5]).double(),
    )
    damping = torch.full((3,), 1e-2, dtype=torch.float64)
    matrix = model.root.T @ model.root + torch.diag(damping)
    best, least = None, INFINITE
    for choice in itertools.product((-1, 0, 1), repeat=3):
        step = torch.where(
            torch.tensor(choice) < 0, lower, torch.where(torch.tensor(choice) > 0, upper, 0.0)
        )
        free = [k for k in range(3) if choice[k] == 0]
        if free:
            right = -(model.gradient + matrix @ step)[free]
            step[free] = torch.linalg.solve(matrix[free][:, free], right)
        value = float(step @ matrix @ step + 2.0 * model.gradient @ step)
        if bool(((step >= lower) & (step <= upper)).all()) and value < least:
            best, least = step, value
    step, _ = bounded_step(model, damping, lower, upper)
    assert torch.allclose(step, best, rtol=1e-9)


def test_a_projected_step_is_no_minimum():
    """S17 cuts each variable for itself; the others do not make up for it."""
    jacobian, residuals, model = model_of(30, 4, 5, condition=2.0)
    damping = torch.full((4,), 1e-9, dtype=torch.float64)
    wide = torch.full((4,), INFINITE, dtype=torch.float64)
    free = damped_step(model, damping)
    assert torch.allclose(projected_step(model, damping, -wide, wide).step, free)
    upper = torch.where(free > 0, 0.3 * free, wide)
    cut = projected_step(model, damping, -wide, upper)
    best = bounded_step(model, damping, -wide, upper)
    assert bool((cut.active == (free > 0)).all())
    lengths = [float((residuals + jacobian @ s.step).norm()) for s in (cut, best)]
    assert lengths[1] < lengths[0]


def test_sums_give_the_step_that_rows_give():
    jacobian, residuals, model = model_of(50, 6, 2)
    sums = LinearModel.of_sums(
        float(residuals @ residuals), jacobian.T @ residuals, jacobian.T @ jacobian
    )
    damping = 1e-2 * model.column_norms.square()
    assert torch.allclose(damped_step(sums, damping), damped_step(model, damping), rtol=1e-8)
    step = damped_step(model, damping)
    expected = float(residuals @ residuals - (residuals + jacobian @ step).square().sum())
    assert sums.reduction(step) == pytest.approx(expected, rel=1e-9)
    assert model.reduction(step) == pytest.approx(expected, rel=1e-12)


def test_rows_keep_digits_that_sums_lose():
    """A condition of 1e9 is squared by the normal equations, beyond double precision."""
    orthogonal = torch.linalg.qr(
        torch.randn(50, 6, generator=torch.Generator().manual_seed(0)).double()
    ).Q
    turn = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(1)).double()).Q
    jacobian = orthogonal @ torch.diag(torch.logspace(0, -9, 6).double()) @ turn
    wanted = torch.ones(6, dtype=torch.float64)
    residuals = -jacobian @ wanted
    damping = torch.full((6,), 1e-26, dtype=torch.float64)
    rows = damped_step(LinearModel.of_rows(residuals, jacobian), damping)
    sums = damped_step(
        LinearModel.of_sums(
            float(residuals @ residuals), jacobian.T @ residuals, jacobian.T @ jacobian
        ),
        damping,
    )
    assert float((rows - wanted).norm()) < 1e-6
    assert float((sums - wanted).norm()) > 1e-2
    joined = LinearModel.join(
        [LinearModel.of_rows(residuals[k : k + 25], jacobian[k : k + 25]) for k in (0, 25)]
    )
    assert float((damped_step(joined, damping) - wanted).norm()) < 1e-6
