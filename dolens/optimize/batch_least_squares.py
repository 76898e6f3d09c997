"""Damped least squares for many problems at once, each with its own damping, bounds and end.

Every problem has P variables u in a box and a merit ‖r(u)‖².  A step δ minimises
‖r + Jδ‖² + ρ‖Dδ‖² within the box, where D_j is the largest ‖J_j‖ met so far (Marquardt; Moré 1978),
and the damping ρ follows the gain ratio (Nielsen, IMM-REP-1999-05), as in `DampedLeastSquares`.
All problems are evaluated together; those that have ended take part no longer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.cpu import least_squares as kernel

# A step is taken when it lowers the merit by this part of what the model predicts, or more.
_LEAST_GAIN = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e10
# A variable that moves nothing is damped as if it moved this part of what the strongest does.
_LEAST_COLUMN = 1e-10
# Turns that exchange whole blocks of variables with their bounds, and all turns.
_BLOCKS, _TURNS = 3, 400


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

    @staticmethod
    def joined(parts: "Sequence[BatchModel]") -> "BatchModel":
        """Return the models of several groups of problems as one."""
        return BatchModel(
            torch.cat([part.merit for part in parts]),
            torch.cat([part.gradient for part in parts]),
            torch.cat([part.hessian for part in parts]),
        )


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
        InputError: no variables, a lower bound above its upper one, or a tolerance out of range.
    """
    if not 0.0 <= merit_tolerance < 1.0:
        raise InputError(f"merit_tolerance must be at least 0 and below 1, not {merit_tolerance}")
    count, size = start.shape
    if size == 0:
        raise InputError("least squares: there are no variables")
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
    """Return damped steps within their boxes, (n, P): each the minimum of a convex problem.

    Which variables end on a bound is found by block principal pivoting, as in
    `dolens.optimize.linear_least_squares`: guess the set, solve for the rest, and exchange every
    variable that contradicts the guess; after some turns only the last one of them (Murty's rule).
    The rare problem that is not solved within the turns that are allowed has its step put back into
    the box.

    Args:
        model: of n problems.
        damping: ρD², (n, P).
        lower: of the steps, (n, P), at most 0.
        upper: likewise, at least 0.
    """
    if model.gradient.device.type == "cpu" and model.gradient.dtype == torch.float64:
        return kernel.bounded_steps(model.hessian, model.gradient, damping, lower, upper)
    return bounded_steps_by_torch(model, damping, lower, upper)


def bounded_steps_by_torch(
    model: BatchModel, damping: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Return what `bounded_steps` does, by PyTorch's operations, on any device."""
    matrix = model.hessian + torch.diag_embed(damping)
    gradient = model.gradient
    # Of each variable: -1 on its lower bound, +1 on its upper one, 0 free.
    low = (lower >= 0.0) & (gradient > 0.0)
    side = torch.where(low, -1, torch.where((upper <= 0.0) & (gradient < 0.0), 1, 0))
    found = torch.zeros_like(lower)
    left = torch.arange(len(lower))
    for turn in range(_TURNS):
        step = _with_held(matrix, gradient, lower, upper, side)
        slope = torch.einsum("npq,nq->np", matrix, step) + gradient
        scale = 1e-12 * gradient.abs().amax(-1, keepdim=True)
        free = side == 0
        wrong = free & ((step < lower) | (step > upper))
        wrong |= (side < 0) & (slope < -scale) | (side > 0) & (slope > scale)
        found[left] = torch.minimum(torch.maximum(step, lower), upper)
        going = wrong.any(-1)
        if not bool(going.any()):
            break
        if turn >= _BLOCKS:
            last = wrong.shape[1] - 1 - wrong.flip(-1).to(torch.int8).argmax(-1, keepdim=True)
            wrong &= torch.zeros_like(wrong).scatter_(1, last, True)
        beyond = torch.where(step < lower, -1, 1)
        side = torch.where(wrong, torch.where(free, beyond, 0), side)
        left, matrix, gradient = left[going], matrix[going], gradient[going]
        lower, upper, side = lower[going], upper[going], side[going]
    return found


def _with_held(
    matrix: Tensor, gradient: Tensor, lower: Tensor, upper: Tensor, side: Tensor
) -> Tensor:
    """Return the steps that minimise with some variables held on their bounds."""
    free = side == 0
    held = torch.where(side < 0, lower, torch.where(side > 0, upper, 0.0))
    right = -gradient - torch.einsum("npq,nq->np", matrix, held)
    both = free[:, :, None] & free[:, None, :]
    kept = torch.where(both, matrix, 0.0) + torch.diag_embed(1.0 - free.to(matrix))
    root, failed = torch.linalg.cholesky_ex(kept)
    solved = torch.cholesky_solve(torch.where(free, right, 0.0)[:, :, None], root)[:, :, 0]
    solved = torch.where((failed == 0)[:, None], solved, 0.0)
    return torch.where(free, solved, held)
