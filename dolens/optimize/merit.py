"""The merit function of a design: its spots and its operands, as residuals of least squares."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.row_jacobian import jacobian_of
from dolens.optimize.image_quality import ImageQuality, QualityValues, without_edges
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.operands import Operand, UnreachableField, View
from dolens.optimize.variables import DesignVariables


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
    """How sharp a lens is + Σ (weight·deviation of an operand)².

    The first is Σ W_s·(RMS radius of spot s, µm)², or what else an `ImageQuality` sums up.

    Args:
        lens: the lens; not changed, and not looked at again.
        variables: of it.
        quality: residuals of its rays, or None for operands alone.
        operands: what else it should be.

    Raises:
        InputError: a best focus is asked for, and the image quality knows none.
    """

    def __init__(
        self,
        lens: Lens,
        variables: DesignVariables,
        quality: ImageQuality | None,
        operands: Sequence[Operand] = (),
    ) -> None:
        self.lens = copy.deepcopy(lens)
        self.opened = without_edges(self.lens)
        self.variables, self.quality, self.operands = variables, quality, tuple(operands)
        if variables.best_focus and (quality is None or not quality.focusable):
            raise InputError(
                "variable 'sensor_distance': solve 'best_focus' goes with the merit's spots or "
                "wavefronts; vary sensor_distance instead"
            )
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
        quality: values of the rays, or None without them.
        operands: values of all operands, or None where a field's chief ray cannot be found.
        sensor_distance: mm, where it stands.
    """

    def __init__(self, merit: MeritFunction) -> None:
        self._merit = merit
        with torch.no_grad():
            merit.variables.write_to(merit.lens)
            self.quality: QualityValues | None = None
            self._slopes: Tensor | None = None
            if merit.quality is not None:
                self.quality = merit.quality.values(merit.lens)
                if merit.variables.best_focus:
                    self._slopes = merit.quality.slopes(self.quality)
                    shift = merit.quality.best_focus(self.quality, self._slopes)
                    self.quality = merit.quality.refocused(self.quality, self._slopes, shift)
                    merit.lens.sensor_distance += shift
            self.sensor_distance = float(merit.lens.sensor_distance)
            found = _operands(merit)
        self.operands: list[OperandValue] | None = None
        if found is not None:
            self.operands = [
                OperandValue(label, value.item(), operand.deviation(value).item(), operand.weight)
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
        if self.quality is not None:
            if not self._merit.quality.is_usable(self.quality):
                return math.inf
            total += self.quality.merit
        return total

    def loss(self) -> Tensor:
        """The merit with a graph to the variables, for an optimizer that takes gradients.

        The best focus has no graph: there the merit does not change with the focus.
        """
        merit = self._merit
        parameters = merit.variables()
        parts = []
        if merit.quality is not None:
            values = dict(parameters)
            if merit.variables.best_focus:
                values["sensor_distance"] = merit.lens.sensor_distance.detach()
            parts.append(merit.quality.loss(merit.opened, values))
        for operand, _, value in _operands(merit) or []:
            parts.append((operand.weight * operand.deviation(value)).square().reshape(()))
        return torch.stack([part.double() for part in parts]).sum()

    def linear_model(self) -> LinearModel:
        """R and b in the variables u."""
        merit, models = self._merit, []
        if merit.quality is not None:
            names, matrix = merit.variables.derivatives()
            of_lens = merit.quality.linear_model(merit.opened, names, self._slopes)
            models.append(of_lens.of_variables(matrix))
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
