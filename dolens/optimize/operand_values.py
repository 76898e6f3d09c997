"""Operands of a lens are evaluated together, for a merit function, a loss and a step alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.optics.row_jacobian import jacobian_of
from dolens.optimize.operands import LensProperties, Operand


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
    parameters: Mapping[str, Tensor],
    object_distance: float | None,
    crossings: dict[tuple[float, float], Tensor] | None = None,
) -> OperandValues:
    """Evaluate operands of a lens.

    Args:
        operands: none is allowed.
        lens: the lens.
        parameters: name → value, in place of the lens's own; with a graph where derivatives are
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
        lens.system(parameters),
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
