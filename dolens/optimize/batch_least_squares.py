"""Damped least squares for many problems at once, each with its own damping, bounds and end.

Every problem has P variables u in a box and a merit ‖r(u)‖².  A step δ minimises
‖r + Jδ‖² + ρ‖Dδ‖² within the box, where D_j is the largest ‖J_j‖ met so far (Marquardt; Moré 1978),
and the damping ρ follows the gain ratio (Nielsen, IMM-REP-1999-05), as in `DampedLeastSquares`.
All problems are evaluated together; those that have ended take part no longer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from dolens.errors import InputError

# A step is taken when it lowers the merit by this part of what the model predicts, or more.
_LEAST_GAIN = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e10
# A variable that moves nothing is damped as if it moved this part of what the strongest does.
_LEAST_COLUMN = 1e-10
# Solutions with variables on their bounds: so many times variables that leave the box are held.
_PASSES = 4


@dataclass(frozen=True)
class BatchModel:
    """Describes n problems near one point of each, by the normal equations.

    Attributes:
        merit: (n,), ‖r‖²; infinite where a problem cannot be evaluated.
        gradient: (n, P), Jᵀr; of a problem without a merit, anything.
        hessian: (n, P, P), JᵀJ.
    """

    merit: Tensor
    gradient: Tensor
    hessian: Tensor


class Ended(IntEnum):
    """These are the reasons why a problem ended."""

    NOT = 0  # the iterations were used up
    NO_START = 1  # the merit is not finite where it starts
    CONVERGED = 2  # several steps in a row gained less than the tolerance
    STUCK = 3  # no step lowers the merit


@dataclass(frozen=True)
class BatchResult:
    """Describes where L problems ended.

    Attributes:
        values: (L, P).
        merit: (L,).
        iterations: (L,), int64, points evaluated after the first.
        ended: (L,), int8, of `Ended`.
    """

    values: Tensor
    merit: Tensor
    iterations: Tensor
    ended: Tensor


# From the numbers of problems (n,) and their variables (n, P) to their models.
Evaluate = Callable[[Tensor, Tensor], BatchModel]


@torch.no_grad()
def minimise_batch(
    evaluate: Evaluate,
    start: Tensor,
    lower: Tensor,
    upper: Tensor,
    iterations: int,
    merit_tolerance: float = 1e-6,
    patience: int = 3,
    initial_damping: float = 1e-2,
) -> BatchResult:
    """Minimise L sums of squares.

    Args:
        evaluate: gives the models of some of the problems.
        start: (L, P), float64; moved into the box.
        lower: (P,) or (L, P).
        upper: likewise.
        iterations: points evaluated after the first, at most.
        merit_tolerance: a problem has converged when `patience` steps in a row each lower the merit
            by this part or less.
        patience: how many.
        initial_damping: ρ of the first step.

    Raises:
        InputError: a lower bound above its upper one, or a tolerance out of range.
    """
    if not 0.0 <= merit_tolerance < 1.0:
        raise InputError(f"merit_tolerance must be at least 0 and below 1, not {merit_tolerance}")
    count, size = start.shape
    lower, upper = lower.expand(count, size), upper.expand(count, size)
    if bool((lower > upper).any()):
        problem, variable = (int(n) for n in torch.nonzero(lower > upper)[0])
        raise InputError(
            f"problem {problem}, variable {variable}: lower bound {lower[problem, variable]:g} "
            f"exceeds upper {upper[problem, variable]:g}"
        )
    values = torch.minimum(torch.maximum(start, lower), upper)
    merit = start.new_full((count,), torch.inf)
    used = torch.zeros(count, dtype=torch.int64)
    ended = torch.full((count,), int(Ended.NOT), dtype=torch.int8)
    which = torch.arange(count)
    found = evaluate(which, values)
    merit = found.merit.clone()
    can = torch.isfinite(merit)
    ended[~can] = int(Ended.NO_START)
    state = _State.at_start(which, values, found, initial_damping).chosen(can)
    for iteration in range(1, iterations + 1):
        if not len(state.which):
            break
        low, high = lower[state.which], upper[state.which]
        state.weight = torch.maximum(state.weight, _column_squares(state.model))
        step = bounded_steps(
            state.model,
            state.damping[:, None] * state.weight,
            low - state.values,
            high - state.values,
        )
        predicted = predicted_gain(state.model, step)
        tried = torch.minimum(torch.maximum(state.values + step, low), high)
        trial = evaluate(state.which, tried)
        gain = state.model.merit - trial.merit
        ratio = torch.where(torch.isfinite(trial.merit), gain / predicted, -torch.inf)
        taken = (ratio > _LEAST_GAIN) & (predicted > 0.0)
        small = taken & (gain <= merit_tolerance * state.model.merit)
        state = state.moved(taken, small, tried, trial, ratio)
        merit[state.which], values[state.which] = state.model.merit, state.values
        used[state.which] = iteration
        converged = state.small_steps >= patience
        stuck = (state.damping >= _MOST_DAMPING) | ~(predicted > 0.0)
        ended[state.which[stuck]] = int(Ended.STUCK)
        ended[state.which[converged]] = int(Ended.CONVERGED)
        going = ~(converged | stuck)
        if not bool(going.all()):
            state = state.chosen(going)
    return BatchResult(values, merit, used, ended)


@dataclass
class _State:
    """Holds the problems that go on."""

    which: Tensor
    values: Tensor
    model: BatchModel
    weight: Tensor
    damping: Tensor
    growth: Tensor
    small_steps: Tensor

    @staticmethod
    def at_start(which: Tensor, values: Tensor, model: BatchModel, damping: float) -> "_State":
        ones = torch.ones_like(model.merit)
        return _State(
            which,
            values,
            model,
            torch.zeros_like(values),
            damping * ones,
            2.0 * ones,
            torch.zeros(len(which), dtype=torch.int64),
        )

    def chosen(self, kept: Tensor) -> "_State":
        """Return the problems of a mask."""
        return _State(
            self.which[kept],
            self.values[kept],
            BatchModel(self.model.merit[kept], self.model.gradient[kept], self.model.hessian[kept]),
            self.weight[kept],
            self.damping[kept],
            self.growth[kept],
            self.small_steps[kept],
        )

    def moved(
        self, taken: Tensor, small: Tensor, tried: Tensor, trial: BatchModel, ratio: Tensor
    ) -> "_State":
        """Return the state after the trials, of which some are taken."""
        column = taken[:, None]
        less = torch.clamp(1.0 - (2.0 * ratio.clamp(-1e3, 1e3) - 1.0) ** 3, min=1.0 / 3.0)
        less = less.clamp(max=2.0)
        damping = self.damping * torch.where(taken, less, self.growth)
        return _State(
            self.which,
            torch.where(column, tried, self.values),
            BatchModel(
                torch.where(taken, trial.merit, self.model.merit),
                torch.where(column, trial.gradient, self.model.gradient),
                torch.where(column[:, :, None], trial.hessian, self.model.hessian),
            ),
            self.weight,
            damping.clamp(_LEAST_DAMPING, _MOST_DAMPING),
            torch.where(taken, 2.0, 2.0 * self.growth),
            torch.where(taken, torch.where(small, self.small_steps + 1, 0), self.small_steps),
        )


def _column_squares(model: BatchModel) -> Tensor:
    """Return ‖J_j‖² of each problem, (n, P), none of them zero."""
    squares = model.hessian.diagonal(dim1=-2, dim2=-1)
    largest = squares.amax(-1, keepdim=True)
    return torch.maximum(squares, _LEAST_COLUMN * largest).clamp(min=1e-300)


def predicted_gain(model: BatchModel, step: Tensor) -> Tensor:
    """Return what the linear model says that steps (n, P) lower the merits by, (n,)."""
    curved = torch.einsum("np,npq,nq->n", step, model.hessian, step)
    return -(2.0 * (model.gradient * step).sum(-1) + curved)


def bounded_steps(model: BatchModel, damping: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return damped steps within their boxes, (n, P).

    Variables on a bound that the gradient presses them against stay.  The others are solved for;
    those that then leave the box are held at its edge, and the rest is solved for again, a few
    times.  What is still outside in the end is put back.  So the step is the exact minimum in
    nearly all cases, and always one within the box that the predicted gain can judge.

    Args:
        model: of n problems.
        damping: ρD², (n, P).
        lower: of the steps, (n, P), at most 0.
        upper: likewise, at least 0.
    """
    matrix = model.hessian + torch.diag_embed(damping)
    free = ~((lower >= 0.0) & (model.gradient > 0.0) | (upper <= 0.0) & (model.gradient < 0.0))
    held = torch.zeros_like(lower)
    step = held
    for _ in range(_PASSES):
        both = free[:, :, None] & free[:, None, :]
        pivots = torch.where(both, matrix, 0.0) + torch.diag_embed(1.0 - free.to(matrix))
        right = -model.gradient - torch.einsum("npq,nq->np", model.hessian, held)
        right = torch.where(free, right, 0.0)
        root, failed = torch.linalg.cholesky_ex(pivots)
        solved = torch.cholesky_solve(right[:, :, None], root)[:, :, 0]
        solved = torch.where((failed == 0)[:, None], solved, 0.0)
        step = torch.where(free, solved, held)
        clipped = torch.minimum(torch.maximum(step, lower), upper)
        outside = free & (clipped != step)
        if not bool(outside.any()):
            return step
        held = torch.where(outside, clipped, held)
        free = free & ~outside
    return torch.minimum(torch.maximum(step, lower), upper)
