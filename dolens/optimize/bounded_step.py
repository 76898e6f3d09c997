"""A damped least-squares step within bounds is a small convex problem, solved exactly here.

    minimise ‖b + Rδ‖² + Σ d_j δ_j²   with   lower ≤ δ ≤ upper

Which variables end on a bound is found by block principal pivoting (Portugal, Júdice and Vicente,
Math. Comp. 63, 1994): guess the set, solve for the rest, and exchange every variable that
contradicts the guess; should that go round in circles, exchange only the last of them (Murty's
rule), which ends after finitely many turns because d > 0 makes the problem strictly convex.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optimize.linear_model import LinearModel

# Exchanges of whole blocks without progress before single ones.
_PATIENCE = 3


class BoundedStep(NamedTuple):
    """Holds a step δ (P,) and, for each variable, the bound that stops it: -1 lower, +1 upper, 0
    none.
    """

    step: Tensor
    active: Tensor


def damped_step(model: LinearModel, damping: Tensor) -> Tensor:
    """Return the step without bounds, (P,): the solution of (RᵀR + diag d)·δ = -Rᵀb (S15).

    It is the least-squares solution of the rows R and diag √d together, by an orthogonal
    factorisation, so that its error goes with R's condition number and not with the square.

    Args:
        model: R and b.
        damping: d (P,), positive.
    """
    return _solve(model, damping, torch.zeros_like(damping), torch.ones_like(damping).bool())


def bounded_step(model: LinearModel, damping: Tensor, lower: Tensor, upper: Tensor) -> BoundedStep:
    """Return the step that minimises the damped sum of squares within bounds.

    Args:
        model: R and b.
        damping: d (P,), positive.
        lower: (P,), at most zero; -inf where there is none.
        upper: (P,), at least zero; inf where there is none.

    Raises:
        InputError: there are no variables.
    """
    count = len(damping)
    if count == 0:
        raise InputError("least squares: there are no variables")
    state = torch.zeros(count, dtype=torch.int8)
    # A bound that the variable sits on, and that the gradient presses it against, is a first guess.
    state[(lower == 0.0) & (model.gradient > 0.0)] = -1
    state[(upper == 0.0) & (model.gradient < 0.0)] = 1
    fewest, patience = count + 1, _PATIENCE
    for _ in range(50 + 20 * count):
        held = torch.where(state < 0, lower, torch.where(state > 0, upper, 0.0))
        free = state == 0
        step = _solve(model, damping, held, free)
        # Half the derivative of what is minimised: its sign says which way a held variable pulls.
        slope = model.root.T @ (model.right + model.root @ step) + damping * step
        low, high = free & (step < lower), free & (step > upper)
        release = ((state < 0) & (slope < 0.0)) | ((state > 0) & (slope > 0.0))
        release &= lower < upper
        wrong = low | high | release
        number = int(wrong.sum())
        if number == 0:
            return BoundedStep(step, state)
        if number < fewest:
            fewest, patience = number, _PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            last = torch.zeros_like(wrong)
            last[int(torch.nonzero(wrong).amax())] = True
            low, high, release = low & last, high & last, release & last
        state = state.clone()
        state[low], state[high], state[release] = -1, 1, 0
    # Only rounding can bring us here: what remains wrong is below it.
    return BoundedStep(step.clamp(lower, upper), state)


def projected_step(
    model: LinearModel, damping: Tensor, lower: Tensor, upper: Tensor
) -> BoundedStep:
    """Return the step without bounds, projected onto them variable by variable (S17)."""
    step = damped_step(model, damping)
    active = (step > upper).to(torch.int8) - (step < lower).to(torch.int8)
    return BoundedStep(step.clamp(lower, upper), active)


def _solve(model: LinearModel, damping: Tensor, held: Tensor, free: Tensor) -> Tensor:
    """Return the minimum over the free variables while the others are held."""
    step = torch.where(free, 0.0, held)
    places = torch.nonzero(free).squeeze(1)
    if len(places) == 0:
        return step
    root, weight = model.root[:, places], damping[places].sqrt()
    right = model.right + model.root @ step
    rows = torch.cat(
        [torch.cat([root, right[:, None]], 1), torch.nn.functional.pad(torch.diag(weight), (0, 1))]
    )
    size = len(places)
    factor = torch.linalg.qr(rows, mode="r").R
    step[places] = -torch.linalg.solve_triangular(
        factor[:size, :size], factor[:size, size:], upper=True
    ).squeeze(1)
    return step
