"""Residuals of least squares, their linear model, and the damped step that solves it in bounds.

Near a point r(u + δ) ≈ r + J·δ, and all that a step needs of J (N × P) is a matrix R of few rows
with RᵀR = JᵀJ and a vector b with Rᵀb = Jᵀr: then ‖r + Jδ‖² = ‖b + Rδ‖² + what no δ changes.

A damped least-squares step within bounds is a small convex problem, solved exactly here.

    minimise ‖b + Rδ‖² + Σ d_j δ_j²   with   lower ≤ δ ≤ upper

Which variables end on a bound is found by block principal pivoting (Portugal, Júdice and Vicente,
Math. Comp. 63, 1994): guess the set, solve for the rest, and exchange every variable that
contradicts the guess; should that go round in circles, exchange only the last of them (Murty's
rule), which ends after finitely many turns because d > 0 makes the problem strictly convex.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.autograd import jacobian_by_columns, jacobian_of


@dataclass(frozen=True)
class LinearModel:
    """Describes residuals that change by J·δ.  P variables; K rows, P or more; double precision,
    CPU.

    Attributes:
        sum_of_squares: ‖r‖².
        root: R (K, P), RᵀR = JᵀJ.
        right: b (K,), Rᵀb = Jᵀr.
    """

    sum_of_squares: float
    root: Tensor
    right: Tensor

    @staticmethod
    def of_rows(residuals: Tensor, jacobian: Tensor) -> "LinearModel":
        """Return the model of r (N,) and J (N, P), by an orthogonal factorisation.

        J = QR and b = Qᵀr: unlike the normal equations this does not square J's condition number.
        """
        residuals, jacobian = _on_cpu(residuals), _on_cpu(jacobian)
        rows, columns = jacobian.shape
        square = float(residuals @ residuals)
        if rows <= columns:
            return LinearModel(square, jacobian, residuals)
        # R of [J r] holds R of J, and b in its last column; Q is never made.
        joined = torch.linalg.qr(torch.cat([jacobian, residuals[:, None]], 1), mode="r").R
        return LinearModel(square, joined[:columns, :columns], joined[:columns, columns])

    @staticmethod
    def of_sums(sum_of_squares: float, jtr: Tensor, jtj: Tensor) -> "LinearModel":
        """Return the model of ‖r‖², Jᵀr (P,) and JᵀJ (P, P), where J itself was never stored.

        JᵀJ = VΛVᵀ gives R = Λ½Vᵀ.  Directions whose eigenvalue is below rounding are left out: the
        sums do not know them.
        """
        jtr, jtj = _on_cpu(jtr), _on_cpu(jtj)
        values, vectors = torch.linalg.eigh(jtj)
        noise = torch.finfo(torch.float64).eps * len(values) * values.abs().amax()
        kept = values > noise
        root = torch.where(kept, values, 0.0).sqrt()
        inverse = torch.where(kept, 1.0 / torch.where(kept, root, 1.0), 0.0)
        return LinearModel(
            float(sum_of_squares), root[:, None] * vectors.T, inverse * (vectors.T @ jtr)
        )

    @staticmethod
    def constant(sum_of_squares: float, variables: int) -> "LinearModel":
        """Return the model of residuals that no variable changes."""
        zero = torch.zeros(0, variables, dtype=torch.float64)
        return LinearModel(sum_of_squares, zero, torch.zeros(0, dtype=torch.float64))

    @staticmethod
    def join(models: Sequence["LinearModel"]) -> "LinearModel":
        """Return the model of all residuals together, of several parts over the same variables."""
        if len(models) == 1:
            return models[0]
        root = torch.cat([model.root for model in models])
        right = torch.cat([model.right for model in models])
        joined = LinearModel.of_rows(right, root)
        return LinearModel(sum(model.sum_of_squares for model in models), joined.root, joined.right)

    def scaled(self, factor: float) -> "LinearModel":
        """Return the model of residuals that are this many times as large."""
        return LinearModel(factor**2 * self.sum_of_squares, factor * self.root, factor * self.right)

    def of_variables(self, derivatives: Tensor) -> "LinearModel":
        """Return the model in other variables u, from the derivatives ∂θ/∂u (P, Q)."""
        return LinearModel(self.sum_of_squares, self.root @ _on_cpu(derivatives), self.right)

    @cached_property
    def column_norms(self) -> Tensor:
        """Return ‖J_j‖ (P,): how much the residuals change with each variable."""
        return torch.linalg.vector_norm(self.root, dim=0)

    @cached_property
    def gradient(self) -> Tensor:
        """Return Jᵀr (P,): half the gradient of ‖r‖²."""
        return self.root.T @ self.right

    def reduction(self, step: Tensor) -> float:
        """Return ‖r‖² - ‖r + Jδ‖², which the model predicts of a step δ (P,)."""
        change = self.root @ step
        return float(-(change @ (change + 2.0 * self.right)))


def _on_cpu(tensor: Tensor) -> Tensor:
    return tensor.detach().to(device="cpu", dtype=torch.float64)


logger = logging.getLogger(__name__)

# So many times as many residuals as variables are worth the second graph of forward sweeps.
_MANY = 4


@runtime_checkable
class Residuals(Protocol):
    """Evaluates residuals r at a point.

    A merit function of rays knows its Jacobian better than autograd does, and may never store it;
    a closure may return such an object instead of a tensor of residuals.
    """

    def sum_of_squares(self) -> float:
        """Return ‖r‖²; `inf` or NaN where the point cannot be evaluated, as when rays fail."""
        ...

    def linear_model(self) -> LinearModel:
        """Return R and b in the optimizer's variables, in the order of its parameters."""
        ...


class TensorResiduals:
    """Holds residuals as a tensor with a graph; autograd sweeps it once for each of the fewer
    numbers.

    Few residuals of many variables take a reverse sweep each, many of few variables a forward one
    for each variable.  Forward sweeps need operations that can be differentiated twice: where one
    cannot, as the fused kernels, the log says so, and reverse sweeps serve.

    Args:
        residuals: r, of any shape.
        variables: leaves that r was computed from; P numbers in all.
    """

    def __init__(self, residuals: Tensor, variables: Sequence[Tensor]) -> None:
        self._residuals, self._variables = residuals.reshape(-1), list(variables)

    def sum_of_squares(self) -> float:
        """Return ‖r‖²."""
        return float(self._residuals.detach().double().square().sum())

    def linear_model(self) -> LinearModel:
        """Return R and b.

        Raises:
            InputError: the residuals have no graph.
        """
        if not self._residuals.requires_grad:
            raise InputError("the closure's residuals have no gradient with respect to anything")
        if not all(variable.requires_grad for variable in self._variables):
            raise InputError("least squares: a variable has no gradient (requires_grad is False)")
        return LinearModel.of_rows(self._residuals, self._jacobian())

    def _jacobian(self) -> Tensor:
        variables = sum(variable.numel() for variable in self._variables)
        if len(self._residuals) > _MANY * variables:
            try:
                return jacobian_by_columns(self._residuals, self._variables)
            except (RuntimeError, InputError) as reason:
                _say_reverse(str(reason).splitlines()[0])
        return jacobian_of(self._residuals, self._variables)


@cache
def _say_reverse(reason: str) -> None:
    logger.info("Jacobian by one reverse sweep for each residual: %s", reason)


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
