"""Operands of a lens are evaluated together, and near a point their residuals are linear."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.optics.autograd import jacobian_of
from dolens.optics.lens import Lens
from dolens.optimize.linear_least_squares import LinearModel
from dolens.optimize.operands import LensProperties, Operand
from dolens.optimize.variables import DesignVariables


@dataclass(frozen=True)
class OperandValue:
    """Holds an operand's value at a point of the search.

    Attributes:
        label: its kind, and which gap or field.
        value: in its own unit.
        deviation: from its target, or beyond its limits.
        weight: of the deviation.
    """

    label: str
    value: float
    deviation: float
    weight: float

    def in_state(self, name: str) -> "OperandValue":
        """Return the same with the name of a state before its label, as `wide/efl`."""
        return replace(self, label=f"{name}/{self.label}")


@dataclass(frozen=True)
class OperandValues:
    """Holds values of operands, with a graph to the parameters that they were computed from.

    An operand with several values, as the thicknesses of all gaps, is here once for each of them.

    Attributes:
        operands: n operands, the one that each value belongs to.
        labels: n labels: the kind, and which gap or field.
        tensors: n scalars, each in its own unit.
    """

    operands: tuple[Operand, ...]
    labels: tuple[str, ...]
    tensors: tuple[Tensor, ...]

    def penalties(self) -> list[Tensor]:
        """Return (weight·deviation)² of each value: n scalars with a graph."""
        return [
            (operand.weight * operand.deviation(value)).square().reshape(())
            for operand, value in zip(self.operands, self.tensors, strict=True)
        ]

    def numbers(self) -> list[OperandValue]:
        """Return the values without their graph."""
        return [
            OperandValue(label, value.item(), operand.deviation(value).item(), operand.weight)
            for operand, label, value in zip(self.operands, self.labels, self.tensors, strict=True)
        ]

    def vector(self) -> Tensor:
        """Return the values (n,) without their graph, double precision, CPU."""
        found = [value.detach().reshape(()).double().cpu() for value in self.tensors]
        return torch.stack(found) if found else torch.zeros(0, dtype=torch.float64)

    def derivatives(self, leaves: Sequence[Tensor]) -> Tensor:
        """Return the derivatives (n, P) with respect to leaves of P numbers, in double precision.

        Each value takes one reverse sweep.
        """
        if not any(value.requires_grad for value in self.tensors):
            count = sum(leaf.numel() for leaf in leaves)
            return torch.zeros(len(self.tensors), count, dtype=torch.float64)
        with torch.enable_grad():
            values = torch.stack([value.reshape(()) for value in self.tensors])
            return jacobian_of(values, list(leaves)).double().cpu()


def evaluate_operands(
    operands: Sequence[Operand],
    lens: Lens,
    object_distance: float | None,
    crossings: dict[tuple[float, float], Tensor] | None = None,
) -> OperandValues:
    """Evaluate operands of a lens.

    Args:
        operands: none is allowed.
        lens: the lens; with values that have a graph (`Lens.with_values`) where derivatives are
            asked for.
        object_distance: mm in front of the first vertex; None for infinity.
        crossings: where chief rays crossed the front at an earlier point, from which their aiming
            begins; this point's are stored in it.  None: aiming begins anew.

    Raises:
        UnreachableField: the chief ray of an operand's field does not reach the stop.
    """
    if not operands:
        return OperandValues((), (), ())
    properties = LensProperties(
        lens.system(),
        lens.primary_wavelength,
        object_distance,
        {} if crossings is None else crossings,
    )
    found = [
        (operand, label, value)
        for operand in operands
        for label, value in operand.values(properties).items()
    ]
    return OperandValues(*zip(*found, strict=True))


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
            found = evaluate_operands(operands, lens.with_values(variables()), object_distance)
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
