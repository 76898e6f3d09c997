"""Damped least squares (Levenberg, Marquardt) is an optimizer of PyTorch here (S12 to S17)."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.optimize.linear_least_squares import (
    LinearModel,
    Residuals,
    TensorResiduals,
    bounded_step,
    projected_step,
)

DAMPINGS = ("multiplicative", "identity")
BOUNDS = ("active", "projected")
# A step is taken when it lowers the merit by this part of what the model predicts, or more.
_LEAST_GAIN = 1e-4
# Damping stays within these; below the first a step is Gauss and Newton's, above nothing moves.
_LEAST_DAMPING, _MOST_DAMPING = 1e-20, 1e20
# A variable that moves nothing is damped as if it moved this part of what the strongest does.
_LEAST_COLUMN = 1e-12
_EPS = torch.finfo(torch.float64).eps
_ROUNDING = 8.0 * _EPS


@dataclass(frozen=True)
class Iteration:
    """Reports one call of `step`.

    Attributes:
        merit: ‖r‖² at the point reached.
        merit_before: where the step began.
        damping: ρ of the step that was taken, or tried last.
        step_norm: its length in the optimizer's variables; 0 where none was taken.
        gain_ratio: what it gained over what the model predicted; NaN where none was taken.
        active_bounds: variables that a bound stops.
        trials: points evaluated after the first.
        failed_trials: those of them where the residuals were no finite numbers.
    """

    merit: float
    merit_before: float
    damping: float
    step_norm: float
    gain_ratio: float
    active_bounds: int
    trials: int
    failed_trials: int


class DampedLeastSquares(torch.optim.Optimizer):
    """Minimises ‖r(u)‖² over variables u within a box.

    A step δ minimises ‖r + Jδ‖² + ρ‖Dδ‖² (S13).  The damping ρ follows the gain ratio, what a step
    gained over what the linear model predicted: after a good step it falls to as little as a third,
    after each refused one it grows by 2, 4, 8, ... (Nielsen, IMM-REP-1999-05).  Points where the
    residuals are not finite are refused like any other that is worse, so that the step shrinks.

    When nothing can be gained any more `stopped` says why, and `step` returns at once.

    Args:
        params: tensors, or groups with `lower` and `upper`: numbers or tensors that broadcast with
            each tensor of the group, or None.  They are moved into their bounds at the first step.
        damping: `multiplicative`, D_j the largest ‖J_j‖ met so far, whatever the variables' units
            (Marquardt; Moré 1978); or `identity`, one D for all (S15): the largest ‖J_j‖ of the
            first point, so that ρ has no unit either.
        initial_damping: ρ of the first step.

    Rarely needed:
        bounds: `active`: the step is the minimum within the box; or `projected`: the minimum
            without it, put back (S17).
        merit_tolerance: stop when a step's actual and predicted gains are this part of the merit.
        step_tolerance: stop when ‖Dδ‖ is this part of ‖Du‖.
        gradient_tolerance: stop when the cosine between r and every column of J that is free to
            move is at most this.
        max_trials: points evaluated in one step before it gives up.

    Raises:
        InputError: no variables, an unknown choice, a tolerance out of range, or bounds that
            exclude each other.
    """

    # Its closure returns residuals, unlike every other optimizer's.
    takes_residuals: ClassVar[bool] = True

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        damping: str = "multiplicative",
        initial_damping: float = 1e-3,
        bounds: str = "active",
        merit_tolerance: float = 1e-12,
        step_tolerance: float = 1e-12,
        gradient_tolerance: float = 1e-12,
        max_trials: int = 40,
    ) -> None:
        check_choice(damping, DAMPINGS, "damping")
        check_choice(bounds, BOUNDS, "bounds")
        for name, value in (
            ("merit_tolerance", merit_tolerance),
            ("step_tolerance", step_tolerance),
            ("gradient_tolerance", gradient_tolerance),
        ):
            if not 0.0 <= value < 1.0:
                raise InputError(f"{name} must be at least 0 and below 1, not {value}")
        if not 0.0 < initial_damping < math.inf:
            raise InputError(f"initial_damping must be positive, not {initial_damping}")
        if max_trials < 1:
            raise InputError(f"max_trials must be at least 1, not {max_trials}")
        given: list[Any] = list(params)
        # PyTorch refuses an empty list in its own words.
        super().__init__(given or [{"params": []}], {"lower": None, "upper": None})
        self.damping, self.initial_damping = damping, initial_damping
        self.bounds = bounds
        self.merit_tolerance, self.step_tolerance = merit_tolerance, step_tolerance
        self.gradient_tolerance, self.max_trials = gradient_tolerance, max_trials
        self.last: Iteration | None = None
        self._variables = [p for group in self.param_groups for p in group["params"]]
        if not sum(variable.numel() for variable in self._variables):
            raise InputError("least squares: there are no variables")
        self._lower, self._upper = self._bound("lower", -math.inf), self._bound("upper", math.inf)
        empty = self._lower > self._upper
        if bool(empty.any()):
            at = int(torch.nonzero(empty)[0])
            raise InputError(
                f"variable {at}: lower bound {self._lower[at]:g} exceeds upper {self._upper[at]:g}"
            )

    # ---------------------------------------------------------------- state

    @property
    def _memory(self) -> dict[str, Any]:
        """Return the state for a checkpoint: ρ, the factor of its next growth, D, and the reason to
        stop.
        """
        return self.state[self._variables[0]]

    @property
    def stopped(self) -> str | None:
        """Return why nothing more can be gained, in words; None while something may be."""
        return self._memory.get("stopped")

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state: PyTorch takes the text of `stopped` for a sequence, and spoils it."""
        super().load_state_dict(state_dict)
        first = state_dict["param_groups"][0]["params"][0]
        stopped = state_dict["state"].get(first, {}).get("stopped")
        if stopped is not None:
            self._memory["stopped"] = stopped

    def restart(self) -> None:
        """Go on after the problem has changed: forget D and that it was solved, keep ρ."""
        self._memory.pop("stopped", None)
        self._memory.pop("columns", None)
        self._memory.pop("first", None)

    def _bound(self, key: str, default: float) -> Tensor:
        parts = []
        for group in self.param_groups:
            for parameter in group["params"]:
                value = group[key]
                bound = torch.as_tensor(default if value is None else value, dtype=torch.float64)
                parts.append(bound.cpu().expand(parameter.shape).reshape(-1))
        return torch.cat(parts)

    def _point(self) -> Tensor:
        return torch.cat([p.detach().reshape(-1).double().cpu() for p in self._variables])

    def _move(self, point: Tensor) -> None:
        parts = point.split([p.numel() for p in self._variables])
        for parameter, part in zip(self._variables, parts, strict=True):
            parameter.copy_(part.reshape(parameter.shape))

    # ---------------------------------------------------------------- one iteration

    @torch.no_grad()
    def step(  # type: ignore[override]  # a closure of residuals is needed
        self, closure: Callable[[], Tensor | Residuals]
    ) -> Tensor:
        """Make one iteration: compute a Jacobian, and try steps until one of them is better.

        Args:
            closure: evaluates at the variables' values and returns the residuals: a tensor, or an
                object as `Residuals`.  It is called with gradients enabled where the Jacobian will
                be asked for, and without for a trial.

        Returns:
            ‖r‖² at the point reached.

        Raises:
            InputError: there are no residuals, or those where the step begins, or their
                derivatives, are not finite.
        """
        if self.stopped:
            return torch.tensor(self._memory["merit"], dtype=torch.float64)
        point = self._point().clamp(self._lower, self._upper)
        self._move(point)
        with torch.enable_grad():
            residuals = self._evaluate(closure)
            merit = residuals.sum_of_squares()
            if not math.isfinite(merit):
                raise InputError(f"least squares cannot begin: the merit is {merit}")
            model = residuals.linear_model()
        if not bool(torch.isfinite(model.root).all()):
            raise InputError("least squares cannot go on: the Jacobian is not finite")
        memory = self._memory
        memory.setdefault("first", merit)
        rho, growth = memory.get("rho", self.initial_damping), memory.get("growth", 2.0)
        weight = self._weights(model)
        lower, upper = self._lower - point, self._upper - point
        solve = bounded_step if self.bounds == "active" else projected_step
        trials = failed = 0
        reason = self._solved(model, merit, lower, upper)
        reached, norm, gain, active = merit, 0.0, math.nan, 0
        while reason is None:
            step, stops = solve(model, rho * weight, lower, upper)
            active = int(torch.count_nonzero(stops))
            predicted = model.reduction(step)
            trial, ratio, hidden = math.inf, -math.inf, False
            if predicted > _ROUNDING * merit:
                self._move((point + step).clamp(self._lower, self._upper))
                trial = self._evaluate(closure).sum_of_squares()
                failed += not math.isfinite(trial)
                if math.isfinite(trial):
                    ratio = (merit - trial) / predicted
                    # Where the merit's own rounding hides a gain, the model knows better.
                    hidden = abs(trial - merit) <= _ROUNDING * merit
            elif self.bounds == "active":
                reason = "no step would change the merit by more than rounding"
                break
            trials += 1
            if ratio > _LEAST_GAIN or hidden:
                reached, norm, gain = trial, float(step.norm()), ratio
                reason = self._small(merit, trial, predicted, step, point, weight)
                if hidden:
                    reason = "the merit changes by no more than rounding"
                less = max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
                memory["rho"], memory["growth"] = max(rho * less, _LEAST_DAMPING), 2.0
                break
            self._move(point)
            if trials == self.max_trials or rho * growth > _MOST_DAMPING:
                reason = f"no step lowers the merit: {trials} were tried, {failed} failed"
            rho, growth = rho * growth, 2.0 * growth
            memory["rho"], memory["growth"] = min(rho, _MOST_DAMPING), growth
        memory["merit"] = reached
        if reason is not None:
            memory["stopped"] = reason
        self.last = Iteration(reached, merit, rho, norm, gain, active, trials, failed)
        return torch.tensor(reached, dtype=torch.float64)

    def _evaluate(self, closure: Callable[[], Tensor | Residuals]) -> Residuals:
        found = closure()
        if isinstance(found, Tensor):
            if not found.numel():
                raise InputError("least squares: there are no residuals")
            if found.is_complex():
                raise InputError("least squares: the residuals are complex; give their parts")
            return TensorResiduals(found, self._variables)
        if not isinstance(found, Residuals):
            raise InputError(
                f"least squares: the closure returns {type(found).__name__}; allowed: a tensor of "
                "residuals, or an object as dolens.optimize.linear_least_squares.Residuals"
            )
        return found

    def _weights(self, model: LinearModel) -> Tensor:
        """Return D², (P,)."""
        columns = model.column_norms
        kept = self._memory.get("columns")
        if self.damping == "identity":
            columns = kept if kept is not None else columns.amax().expand_as(columns)
        elif kept is not None:
            columns = torch.maximum(columns, kept.to(columns))
        self._memory["columns"] = columns.clone()
        return columns.clamp(min=max(_LEAST_COLUMN * float(columns.amax()), 1e-150)).square()

    # ---------------------------------------------------------------- when to stop

    def _solved(self, model: LinearModel, merit: float, lower: Tensor, upper: Tensor) -> str | None:
        """Return the reason why the point where a step would begin is a minimum, or None."""
        if merit == 0.0:
            return "the merit is zero"
        gradient = model.gradient
        pressed = ((lower == 0.0) & (gradient > 0.0)) | ((upper == 0.0) & (gradient < 0.0))
        if bool(pressed.all()):
            return "every variable is pressed against its bound"
        columns = model.column_norms
        cosine = gradient.abs() / (columns * math.sqrt(merit))
        cosine = torch.where(pressed | (columns == 0.0), 0.0, cosine)
        if float(cosine.amax()) <= self.gradient_tolerance:
            return (
                f"the gradient is zero: cosines with the residuals are {float(cosine.amax()):.1e}"
            )
        return None

    def _small(
        self,
        merit: float,
        trial: float,
        predicted: float,
        step: Tensor,
        point: Tensor,
        weight: Tensor,
    ) -> str | None:
        """Return the reason why the step that was taken is the last that matters, or None."""
        if trial <= _EPS**2 * self._memory["first"]:
            return "the residuals have fallen to the rounding of what they were at first"
        gained = merit - trial
        small = self.merit_tolerance * merit
        if gained <= small and predicted <= small:
            return f"the last step gained {gained / merit:.1e} of the merit"
        scale = weight.sqrt()
        if float((scale * step).norm()) <= self.step_tolerance * float((scale * point).norm()):
            return "the last step is below step_tolerance"
        return None
