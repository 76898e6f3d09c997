"""One iteration of a design, by least squares or by a gradient, and its numbers as tables."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dolens.optimize import DampedLeastSquares, DesignVariables, MeritFunction
from dolens.optimize.linear_least_squares import LinearModel
from dolens.optimize.merit import MeritValue
from dolens.optimize.rounds import spot_labels
from dolens.optimize.states import StatesMerit, StatesValue

# How often a step of a gradient that makes rays fail is halved before it is taken back.
_HALVINGS = 30


@dataclass
class Cost:
    """Counts what an iteration costs.

    Attributes:
        rays: rays traced, also for Jacobians and gradients.
        jacobian_s: seconds spent in Jacobians or gradients.
        evaluations: evaluations of the merit.
    """

    rays: int = 0
    jacobian_s: float = 0.0
    evaluations: int = 0


@dataclass(frozen=True)
class Progress:
    """Holds the result of an iteration.

    Attributes:
        value: the merit where it ended.
        numbers: of the optimizer, by the names that they are logged under.
        cost: of the iteration.
        stopped: why nothing more can be gained, or None.
    """

    value: MeritValue | StatesValue
    numbers: dict[str, float]
    cost: Cost
    stopped: str | None = None


@dataclass
class _CountedValue:
    """Evaluates a merit, and writes down what its Jacobian costs."""

    value: MeritValue | StatesValue
    rays: int
    cost: Cost

    def sum_of_squares(self) -> float:
        return self.value.sum_of_squares()

    def linear_model(self) -> LinearModel:
        started = time.perf_counter()
        model = self.value.linear_model()
        self.cost.jacobian_s += time.perf_counter() - started
        self.cost.rays += self.rays
        return model


@dataclass
class CountedMerit:
    """Evaluates a merit function, and counts its evaluations."""

    merit: MeritFunction | StatesMerit
    cost: Cost = field(default_factory=Cost)
    _last: MeritValue | StatesValue | None = None

    @property
    def rays(self) -> int:
        """Return the number of rays of one evaluation."""
        return sum(len(quality.spots.weight) for quality in self.merit.qualities.values())

    def __call__(self) -> _CountedValue:
        """Return the value at the variables."""
        value = self.merit()
        if value is not self._last:
            self._last = value
            self.cost.rays += self.rays
            self.cost.evaluations += 1
        return _CountedValue(value, self.rays, self.cost)


def least_squares_iteration(
    optimizer: DampedLeastSquares, step: Callable[..., Any], merit: MeritFunction | StatesMerit
) -> Progress:
    """Make a step of an optimizer that takes residuals.

    Args:
        optimizer: knows what its last step did.
        step: of the optimizer, as the training loop wants it called.
        merit: of its variables.
    """
    counted = CountedMerit(merit)
    step(counted)
    last = optimizer.last
    numbers = {}
    if last is not None:
        numbers = {
            "damping": last.damping,
            "step_norm": last.step_norm,
            "gain_ratio": last.gain_ratio,
            "active_bounds": float(last.active_bounds),
            "trials": float(last.trials),
            "failed_trials": float(last.failed_trials),
        }
    return Progress(merit(), numbers, counted.cost, optimizer.stopped)


def gradient_iteration(
    optimizer: torch.optim.Optimizer,
    step: Callable[..., Any],
    merit: MeritFunction | StatesMerit,
    variables: DesignVariables,
) -> Progress:
    """Make a step of an optimizer that takes a gradient, and project it onto the bounds (S17).

    Where it makes rays fail, half of it is taken, or a quarter, and so on.
    """
    counted = CountedMerit(merit)
    before = variables.scaled.detach().clone()

    def closure() -> Tensor:
        value = counted().value
        started = time.perf_counter()
        optimizer.zero_grad()
        loss = value.loss()
        loss.backward()
        counted.cost.jacobian_s += time.perf_counter() - started
        counted.cost.rays += counted.rays
        return loss

    step(closure)
    variables.project()
    failed = 0
    while not math.isfinite(counted().sum_of_squares()):
        failed += 1
        with torch.no_grad():
            half = 0.5 * (before + variables.scaled)
            variables.scaled.copy_(before if failed >= _HALVINGS else half)
        if failed >= _HALVINGS:
            break
    moved = variables.scaled.detach() - before
    at_bound = (variables.scaled <= variables.lower) | (variables.scaled >= variables.upper)
    numbers = {
        "step_norm": float(moved.norm()),
        "active_bounds": float(at_bound.sum()),
        "learning_rate": float(optimizer.param_groups[0].get("lr", math.nan)),
        "failed_trials": float(failed),
    }
    return Progress(merit(), numbers, counted.cost)


def iteration_row(progress: Progress, merit: MeritFunction, seconds: float) -> dict[str, float]:
    """Return the numbers of an iteration, by the names that they are logged under."""
    value, cost = progress.value, progress.cost
    row = {
        "train/merit": value.sum_of_squares(),
        **{f"train/{name}": number for name, number in progress.numbers.items()},
        "cost/iteration_s": seconds,
        "cost/jacobian_s": cost.jacobian_s,
        "cost/iteration_rays": float(cost.rays),
        "cost/evaluations": float(cost.evaluations),
    }
    if value.qualities:
        row["train/quality"] = sum(found.merit for found in value.qualities.values())
    for state, found in value.qualities.items():
        quality = merit.qualities[state]
        before = f"spot_{quality.unit}/" + ("" if state is None else f"{state}/")
        for label, rms in zip(spot_labels(quality.spots), found.rms.tolist(), strict=True):
            row[before + label] = quality.scale * rms
    if value.operands:
        slopes = value.operand_derivatives().norm(dim=1).tolist()
        for item, slope in zip(value.operands, slopes, strict=True):
            row[f"operand/{item.label}"] = item.value
            row[f"operand_slope/{item.label}"] = slope
            row[f"merit/{item.label}"] = (item.weight * item.deviation) ** 2
    return row


def operand_table(merit: MeritFunction) -> list[dict[str, Any]]:
    """Return rows, one for every operand: value, deviation, derivatives by variable.

    Derivatives are those of the value with respect to each variable in the unit of files.
    """
    value = merit()
    if not value.operands:
        return []
    slopes = (value.operand_derivatives() / merit.variables.file_scale.cpu()).tolist()
    labels = merit.variables.labels()
    return [
        {
            "operand": item.label,
            "value": item.value,
            "deviation": item.deviation,
            "weight": item.weight,
            **dict(zip(labels, row, strict=True)),
        }
        for item, row in zip(value.operands, slopes, strict=True)
    ]
