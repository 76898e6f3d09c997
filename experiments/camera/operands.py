"""Operands of a camera's lens, which are added to the loss of its images."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import values_in_state
from dolens.optimize.operand_values import OperandModel, evaluate_operands
from dolens.optimize.operands import UnreachableField, check_operand_fields, operand
from dolens.optimize.variables import DesignVariables

logger = logging.getLogger(__name__)


class CameraOperands:
    """Evaluates operands of a lens whose objects are where a camera looks.

    Args:
        settings: of each operand, as `dolens.optimize.operands.operand` takes them.
        lens: that they are meant for.
        object_distance: mm in front of the first vertex.  Fields of operands are heights (mm)
            there, and angles (degrees) only where it is infinite.

    Attributes:
        entries: the operands.
        object_distance: None for infinity, as operands have it.
        taken_back: steps of the lens that were.

    Raises:
        InputError: a setting that `operand` refuses.
    """

    def __init__(
        self, settings: Sequence[Mapping[str, Any]], lens: Lens, object_distance: float
    ) -> None:
        self.object_distance = object_distance if math.isfinite(object_distance) else None
        self.entries = [operand(entry, lens) for entry in settings]
        check_operand_fields(self.entries, self.object_distance)
        self.taken_back = 0

    def penalty(self, lens: Lens, values: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return Σ (weight·deviation)² and the operands' values by label.

        They are of the lens in none of its states.

        Args:
            lens: that they belong to.
            values: parameters that take the place of its own, by name; with a graph.

        Raises:
            UnreachableField: a chief ray does not reach the stop.
        """
        own = values_in_state(lens, None, values)
        found = evaluate_operands(self.entries, lens, own, self.object_distance)
        total = torch.zeros((), device=lens.device)
        for penalty in found.penalties():
            total = total + penalty
        labelled = zip(found.labels, found.tensors, strict=True)
        return total, {label: value.detach() for label, value in labelled}

    def model(self, lens: Lens, variables: DesignVariables) -> OperandModel | None:
        """Return the operands near the variables' values, for a step; None without operands.

        Raises:
            UnreachableField: a chief ray does not reach the stop.
        """
        if not self.entries:
            return None
        return OperandModel.at(lens, variables, self.entries, self.object_distance)

    def check(self, lens: Lens, values: Mapping[str, Tensor]) -> None:
        """Refuse a lens that training cannot begin with.

        Raises:
            InputError: a chief ray does not reach the stop.
        """
        problem = self._problem(lens, values)
        if problem is not None:
            raise InputError(f"operands: {problem} of lens '{lens.name}' as training begins")

    @torch.no_grad()
    def take_back_if_unreachable(
        self, lens: Lens, variables: DesignVariables, before: Tensor, forget: Callable[[], object]
    ) -> None:
        """Undo a step of the lens after which the operands cannot be evaluated; log it.

        Args:
            lens: that they belong to.
            variables: u after the step; set to `before` where it is undone.
            before: u before it.
            forget: called then, to drop what led there: momentum, or too long a trust radius.
        """
        problem = self._problem(lens, variables())
        if problem is None:
            return
        variables.scaled.copy_(before)
        forget()
        self.taken_back += 1
        logger.warning(
            "A step of the lens is taken back (%d so far): after it, %s",
            self.taken_back,
            problem,
        )

    @torch.no_grad()
    def _problem(self, lens: Lens, values: Mapping[str, Tensor]) -> UnreachableField | None:
        try:
            self.penalty(lens, values)
        except UnreachableField as problem:
            return problem
        return None
