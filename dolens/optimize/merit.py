"""The merit function of a design: its spots and its operands, as residuals of least squares."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.optics.row_jacobian import jacobian_of
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.operands import Operand, UnreachableField, View
from dolens.optimize.spot_residuals import SpotResiduals, SpotValues, without_edges
from dolens.optimize.variables import DesignVariables

# Residuals of spots are in µm, so that operands of some tenths of a millimetre weigh like spots.
MICROMETRES = 1e3


@dataclass(frozen=True)
class OperandValue:
    """An operand at a point of the search.

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


class MeritFunction:
    """Σ W_s·(RMS radius of spot s, µm)² + Σ (weight·deviation of an operand)².

    Args:
        lens: the lens; not changed, and not looked at again.
        variables: of it.
        spots: residuals of its rays, or None for operands alone.
        operands: what else it should be.
    """

    def __init__(
        self,
        lens: Lens,
        variables: DesignVariables,
        spots: SpotResiduals | None,
        operands: Sequence[Operand] = (),
    ) -> None:
        self.lens = copy.deepcopy(lens)
        self.opened = without_edges(self.lens)
        self.variables, self.spots, self.operands = variables, spots, tuple(operands)
        self._last: tuple[Tensor, MeritValue] | None = None

    def __call__(self) -> "MeritValue":
        """The merit at the variables' values; what a `DampedLeastSquares` takes as closure."""
        point = self.variables.scaled.detach()
        # A step begins where the last trial of the one before it ended.
        if self._last is None or not torch.equal(self._last[0], point):
            self._last = point.clone(), MeritValue(self)
        return self._last[1]


class MeritValue:
    """A merit function where its variables are; it is not to outlive their next move.

    Attributes:
        spots: values of the spots, or None without spots.
        operands: values of all operands, or None where a field's chief ray cannot be found.
        sensor_distance: mm, where it stands.
    """

    def __init__(self, merit: MeritFunction) -> None:
        self._merit = merit
        with torch.no_grad():
            merit.variables.write_to(merit.lens)
            self.spots: SpotValues | None = None
            self._slopes: Tensor | None = None
            if merit.spots is not None:
                self.spots = merit.spots.values(merit.lens)
                if merit.variables.best_focus:
                    self._slopes = merit.spots.slopes(self.spots)
                    shift = merit.spots.best_focus(self.spots, self._slopes)
                    self.spots = merit.spots.refocused(self.spots, self._slopes, shift)
                    merit.lens.sensor_distance += shift
            self.sensor_distance = float(merit.lens.sensor_distance)
            found = _operands(merit)
        self.operands: list[OperandValue] | None = None
        if found is not None:
            self.operands = [
                OperandValue(label, float(value), float(operand.deviation(value)), operand.weight)
                for operand, label, value in found
            ]

    @torch.no_grad()
    def write_to(self, lens: Lens) -> None:
        """Store the variables, what follows from them, and the focus in a lens."""
        self._merit.variables.write_to(lens)
        lens.sensor_distance.fill_(self.sensor_distance)

    def sum_of_squares(self) -> float:
        """The merit; `inf` where rays fail or a chief ray cannot be found."""
        if self.operands is None:
            return math.inf
        total = sum((item.weight * item.deviation) ** 2 for item in self.operands)
        if self.spots is not None:
            total += MICROMETRES**2 * self._merit.spots.sum_of_squares(self.spots)
        return total

    def linear_model(self) -> LinearModel:
        """R and b in the variables u."""
        merit, models = self._merit, []
        if merit.spots is not None:
            names, matrix = merit.variables.derivatives()
            of_lens = merit.spots.linear_model(merit.opened, names, self._slopes)
            models.append(of_lens.scaled(MICROMETRES).of_variables(matrix))
        if merit.operands:
            with torch.enable_grad():
                rows = [
                    operand.weight * operand.deviation(value)
                    for operand, _, value in _operands(merit) or []
                ]
                residuals = torch.stack([row.reshape(()) for row in rows])
                jacobian = jacobian_of(residuals, [merit.variables.scaled])
            models.append(LinearModel.of_rows(residuals, jacobian))
        return LinearModel.join(models)


def _operands(merit: MeritFunction) -> list[tuple[Operand, str, Tensor]] | None:
    """Every operand with its labels and values; None where one cannot be evaluated."""
    if not merit.operands:
        return []
    lens = merit.lens
    view = View(lens.system(merit.variables()), lens.primary_wavelength, lens.object_distance)
    try:
        return [
            (operand, label, value)
            for operand in merit.operands
            for label, value in operand.values(view).items()
        ]
    except UnreachableField:
        return None
