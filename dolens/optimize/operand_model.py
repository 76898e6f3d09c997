"""Near a point, operands give residuals that are linear in the variables between their limits."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.operand_values import OperandValues, evaluate_operands
from dolens.optimize.operands import Operand
from dolens.optimize.variables import DesignVariables


@dataclass(frozen=True)
class OperandModel:
    """Predicts values v + V·δ of operands after a step δ (P,).  Double precision, CPU.

    Attributes:
        operands: of each value its own; one that has several values is there several times.
        values: v (n,), each in its own unit.
        derivatives: V (n, P), with respect to the variables.
    """

    operands: tuple[Operand, ...]
    values: Tensor
    derivatives: Tensor

    @staticmethod
    def at(
        lens: Lens,
        variables: DesignVariables,
        operands: Sequence[Operand],
        object_distance: float | None,
    ) -> "OperandModel":
        """Return the model at the variables' values.

        Args:
            lens: the lens that they belong to.
            variables: u.
            operands: none is allowed.
            object_distance: mm in front of the first vertex; None for infinity.

        Raises:
            UnreachableField: a chief ray does not reach the stop.
        """
        with torch.enable_grad():
            found = evaluate_operands(operands, lens, variables(), object_distance)
        return OperandModel.of(found, found.derivatives([variables.scaled]))

    @staticmethod
    def of(found: OperandValues, derivatives: Tensor) -> "OperandModel":
        """Return the model of n values with these derivatives (n, P)."""
        return OperandModel(found.operands, found.vector(), derivatives)

    def gradient(self, step: Tensor) -> Tensor:
        """Return the gradient (P,) of Σ (weight·deviation)² with respect to the variables, after a
        step.
        """
        weight, deviations = self._at(step)
        return 2.0 * self.derivatives.T @ (weight.square() * deviations)

    def near(self, step: Tensor) -> LinearModel:
        """Return residuals of the targets, and of the limits that are broken after a step.

        A limit that is kept there has no slope.  The model is of steps from v, not from there.
        """
        weight, deviations = self._at(step)
        targets = torch.tensor([entry.target is not None for entry in self.operands]).bool()
        weight = weight * ((deviations != 0.0) | targets)
        # What a value is compared with: the target, or the limit that is next to it.
        wanted = self.values + self.derivatives @ step - deviations
        return LinearModel.of_rows(
            weight * (self.values - wanted), weight[:, None] * self.derivatives
        )

    def _at(self, step: Tensor) -> tuple[Tensor, Tensor]:
        after = self.values + self.derivatives @ step
        found = [(o.weight, o.deviation(v)) for o, v in zip(self.operands, after, strict=True)]
        pairs = torch.tensor(found, dtype=torch.float64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]
