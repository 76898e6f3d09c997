"""The merit function of a design gives its spots and its operands as residuals of least squares.

Operands are evaluated together; near a point their residuals are linear.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.autograd import jacobian_of
from dolens.optics.lens import Lens
from dolens.optics.system import require_plane_sensor
from dolens.optimize.image_quality import ImageQuality, QualityValues, without_edges
from dolens.optimize.linear_least_squares import LinearModel
from dolens.optimize.operands import LensProperties, Operand, UnreachableField
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
    ghost_rays: dict[Any, Any] | None = None,
) -> OperandValues:
    """Evaluate operands of a lens.

    Args:
        operands: none is allowed.
        lens: the lens; with values that have a graph (`Lens.with_values`) where derivatives are
            asked for.
        object_distance: mm in front of the first vertex; None for infinity.
        crossings: where chief rays crossed the front at an earlier point, from which their aiming
            begins; this point's are stored in it.  None: aiming begins anew.
        ghost_rays: which rays make ghosts, as an earlier point chose them; None: chosen anew.

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
        {} if ghost_rays is None else ghost_rays,
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


class Variables(Protocol):
    """Gives parameters of a lens as functions of the variables u; see `DesignVariables`."""

    @property
    def best_focus(self) -> bool:
        """Return whether the sensor stands at the best focus of the rays."""
        ...

    @property
    def scaled(self) -> Tensor:
        """Return u (P,)."""
        ...

    def __call__(self) -> dict[str, Tensor]:
        """Return the parameters by name."""
        ...

    def derivatives(self) -> tuple[list[str], Tensor]:
        """Return names of the parameters in the lens's order, and ∂θ/∂u (Q, P)."""
        ...

    def write_to(self, lens: Lens) -> None:
        """Store the parameters in a lens."""
        ...


class MeritFunction:
    """Sums image quality and Σ (weight·deviation of an operand)².

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
        variables: Variables,
        quality: ImageQuality | None,
        operands: Sequence[Operand] = (),
    ) -> None:
        self.lens = lens.storing_its_values()
        self.opened = without_edges(self.lens)
        self.variables, self.quality, self.operands = variables, quality, tuple(operands)
        if variables.best_focus and (quality is None or not quality.focusable):
            raise InputError(
                "variable 'sensor_distance': solve 'best_focus' goes with the merit's spots or "
                "wavefronts; vary sensor_distance instead"
            )
        if variables.best_focus:
            # Landing points are linear in the distance of a plane alone.
            require_plane_sensor(lens.system(), "variable 'sensor_distance': solve 'best_focus'")
        self.crossings: dict[tuple[float, float], Tensor] = {}
        self.ghost_rays: dict[Any, Any] = {}
        self._last: tuple[Tensor, MeritValue] | None = None

    @property
    def qualities(self) -> dict[str | None, ImageQuality]:
        """Return the rays' term under the name None, as a merit of states has one by state."""
        return {} if self.quality is None else {None: self.quality}

    def __call__(self) -> "MeritValue":
        """Return the merit at the variables' values; `DampedLeastSquares` takes it as closure."""
        point = self.variables.scaled.detach()
        # A step begins where the last trial of the one before it ended.
        if self._last is None or not torch.equal(self._last[0], point):
            self._last = point.clone(), MeritValue(self)
        return self._last[1]


class MeritValue:
    """Evaluates a merit function at its variables; it is not to outlive their next move.

    Attributes:
        quality: values of the rays, or None without them.
        operands: values of all operands, or None where a field's chief ray cannot be found.
        sensor_distance: mm, where it stands.
    """

    def __init__(self, merit: MeritFunction) -> None:
        self._merit = merit
        self._focus: Tensor | None = None
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
                    merit.lens.sensor_distance.add_(shift)
            self.sensor_distance = float(merit.lens.sensor_distance)
        # With their graph at once: nearly every point that is tried is where the next step begins.
        self._sensor = merit.lens.sensor_distance.detach().clone().requires_grad_()
        with torch.enable_grad():
            self._found = _operands(merit, self._sensor if merit.variables.best_focus else None)
        self.operands: list[OperandValue] | None = None
        if self._found is not None:
            self.operands = self._found.numbers()

    @property
    def qualities(self) -> dict[str | None, QualityValues]:
        """Return the values of the rays under the name None."""
        return {} if self.quality is None else {None: self.quality}

    @torch.no_grad()
    def write_to(self, lens: Lens) -> None:
        """Store the variables, what follows from them, and the focus in a lens."""
        self._merit.variables.write_to(lens)
        lens.sensor_distance.fill_(self.sensor_distance)

    def foci(self) -> dict[str, float]:
        """Return the sensor's distance (mm) by the name of its parameter."""
        return {"sensor_distance": self.sensor_distance}

    def sum_of_squares(self) -> float:
        """Return the merit; `inf` where rays fail or a chief ray cannot be found."""
        if self.operands is None:
            return math.inf
        weighted = [item.weight * item.deviation for item in self.operands]
        total: float = sum(one * one for one in weighted)  # infinite where a power would raise
        if self.quality is not None and self._merit.quality is not None:
            if not self._merit.quality.is_usable(self.quality):
                return math.inf
            total += self.quality.merit
        return total

    def loss(self) -> Tensor:
        """Return the merit with a graph to the variables, for an optimizer that takes gradients.

        A best focus has no graph: there the sharpness does not change with the focus.  Operands
        that do are seen as if the sensor stood still.
        """
        merit = self._merit
        parameters = merit.variables()
        parts = []
        if merit.quality is not None:
            values = dict(parameters)
            if merit.variables.best_focus:
                values["sensor_distance"] = merit.lens.sensor_distance.detach()
            parts.append(merit.quality.loss(merit.opened, values))
        found = _operands(merit)
        parts += found.penalties() if found is not None else []
        return torch.stack([part.double() for part in parts]).sum()

    def linear_model(self) -> LinearModel:
        """Return R and b in the variables u.

        Raises:
            InputError: there are operands alone, and no variable moves any of them.
        """
        merit = self._merit
        models: list[LinearModel] = []
        if merit.quality is not None and self.quality is not None:
            names, matrix = merit.variables.derivatives()
            if names:
                model, of_lens = merit.quality.linear_model(merit.opened, names, self._slopes)
                models.append(model.of_variables(matrix))
                self._focus = None if of_lens is None else of_lens @ matrix
            else:
                models.append(LinearModel.constant(self.quality.merit, matrix.shape[1]))
        if self._found is not None and self.operands:
            rows = OperandModel.of(self._found, self.operand_derivatives())
            if merit.quality is None and not bool(rows.derivatives.any()):
                labels = ", ".join(self._found.labels)
                raise InputError(f"merit.operands: no variable moves {labels}")
            models.append(rows.near(rows.values.new_zeros(rows.derivatives.shape[1])))
        return LinearModel.join(models)

    def operand_derivatives(self) -> Tensor:
        """Return the derivatives (n, P) of every operand's value with respect to the variables u,
        in the order of `operands`.

        Once the linear model is known the sensor moves with a best focus; before, it stands still.
        """
        rows = self._operand_rows
        if self._focus is None:
            return rows[:, :-1]
        return rows[:, :-1] + torch.outer(rows[:, -1], self._focus)

    @cached_property
    def _operand_rows(self) -> Tensor:
        """Return the derivatives (n, P + 1) of every operand with respect to the variables and,
        last, to the sensor's distance.
        """
        leaves = [self._merit.variables.scaled, self._sensor]
        return (self._found or OperandValues((), (), ())).derivatives(leaves)


def _operands(merit: MeritFunction, sensor_distance: Tensor | None = None) -> OperandValues | None:
    """Return the operands' values; None where one cannot be evaluated."""
    if not merit.operands:
        return OperandValues((), (), ())
    lens = merit.lens.with_values(merit.variables())
    if sensor_distance is not None:
        lens = lens.with_values({"sensor_distance": sensor_distance})
    try:
        distance = lens.object_distance
        kept = merit.crossings, merit.ghost_rays
        return evaluate_operands(merit.operands, lens, distance, *kept)
    except UnreachableField:
        return None
