"""Operands of a camera's lens, and its design for the least deconvolved error before training."""

import copy
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import joined_spots, with_chief_rays
from dolens.errors import InputError
from dolens.experiments.camera.views.base import Imaging
from dolens.optics.lens import Lens
from dolens.optimize import DampedLeastSquares
from dolens.optimize.deconvolved_error import DeconvolvedError, Photographs
from dolens.optimize.merit import MeritFunction, OperandModel, evaluate_operands
from dolens.optimize.operands import UnreachableField, check_operand_fields, operand
from dolens.optimize.ray_intercept_quality import LossResiduals
from dolens.optimize.variables import DesignVariables
from dolens.sensor.readout import Readout

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

    def penalty(self, lens: Lens) -> tuple[Tensor, dict[str, Tensor]]:
        """Return Σ (weight·deviation)² and the operands' values by label.

        They are of the lens in none of its states.

        Args:
            lens: that they belong to; they are differentiable in its given values.

        Raises:
            UnreachableField: a chief ray does not reach the stop.
        """
        found = evaluate_operands(self.entries, lens.in_state(None), self.object_distance)
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

    def check(self, lens: Lens) -> None:
        """Refuse a lens that training cannot begin with.

        Raises:
            InputError: a chief ray does not reach the stop.
        """
        problem = self._problem(lens)
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
        problem = self._problem(lens.with_values(variables()))
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
    def _problem(self, lens: Lens) -> UnreachableField | None:
        try:
            self.penalty(lens)
        except UnreachableField as problem:
            return problem
        return None


# Pixels of mean grey by which a sensor's noise is measured, and that grey, in linear light.
_PROBE, _GREY = 128, 0.2
# A sensor without noise would let a filter undo any blur: that of 12 bits.
_LEAST_NOISE = 1e-8
# Rays pass the lens as it is at the start of a round; of its gain less than this is not worth one.
_ROUNDS, _WORTH = 3, 1e-3
# Gains of one step, over the loss, below which a round ends.
_TOLERANCE = 1e-4
# Rings and arms of rays: spots of ten pixels have transfer functions up to the Nyquist frequency.
_RINGS, _ARMS = 6, 12


@dataclass(frozen=True)
class DeconvolvedDesign:
    """Says what was gained before training.

    Attributes:
        before: the deconvolved error with the operands, shares of the photographs' variance.
        after: the same.
        iterations: of damped least squares.
    """

    before: float
    after: float
    iterations: int


def design_for_deconvolution(
    lens: Lens,
    variables: DesignVariables,
    views: Imaging,
    operands: CameraOperands,
    iterations: int,
    damping: float,
    strength: float,
    view_norm: float,
) -> DeconvolvedDesign:
    """Move a lens by damped least squares to where its deconvolved error is least.

    Args:
        lens: the variables' values are stored in it.
        variables: u; they are moved.
        views: image the scene.
        operands: what the lens must be besides.
        iterations: at most.
        damping: initial, see `DampedLeastSquares`.
        strength: share of the best linear filter that the network is thought to find; see
            `DeconvolvedError`.
        view_norm: p of the power mean of the views' errors.

    Raises:
        InputError: rays fail where training begins.
    """
    first, reached, made = math.nan, math.nan, 0
    for _ in range(_ROUNDS):
        merit = merit_of(lens, variables, views, operands, strength, view_norm)
        steps = DampedLeastSquares(
            [variables.parameter_group()],
            initial_damping=damping,
            merit_tolerance=_TOLERANCE,
        )
        begun = merit().sum_of_squares()
        if not math.isfinite(begun):
            raise InputError(
                "optimizer.least_squares.first_iterations: rays of the views' spots fail where "
                "training begins; allowed there: 0"
            )
        first = begun if made == 0 else first
        reached = begun
        while made < iterations and steps.stopped is None:
            reached, made = float(steps.step(merit)), made + 1
        variables.project()
        variables.write_to(lens)
        if made >= iterations or begun - reached <= _WORTH * begun:
            break
    logger.info(
        "The lens was designed for its deconvolved error in %d iterations: %.4g, before %.4g",
        made,
        reached,
        first,
    )
    return DeconvolvedDesign(first, reached, made)


def merit_of(
    lens: Lens,
    variables: DesignVariables,
    views: Imaging,
    operands: CameraOperands,
    strength: float,
    view_norm: float,
) -> MeritFunction:
    """Return the deconvolved error of a camera's views, with its operands, as a merit function.

    Views of one field at several depths share a filter.
    """
    distances = [distance if math.isfinite(distance) else None for distance in views.scene.depths]
    parts = views.spots(lens, _RINGS, _ARMS)
    spots = joined_spots(
        [with_chief_rays(lens, part, d) for part, d in zip(parts, distances, strict=True)]
    )
    colours = len(views.scene.wavelengths)
    fields = parts[0].count // colours
    photographs = Photographs(views.sensor.pixel_pitch, noise_of(views.readout))
    loss = DeconvolvedError.of_spots(
        spots,
        [number % fields for number in range(fields * len(parts))],
        [number // colours for number in range(spots.count)],
        list(views.spot_weights(fields)) * len(parts),
        photographs,
        view_norm,
        strength,
    )
    even = torch.full((spots.count,), 1.0 / spots.count, dtype=torch.float64)
    quality = LossResiduals(spots, even, "chief", "polychromatic", 1.0, intercept_loss=loss)
    own = copy.deepcopy(lens)
    own.object_distance = operands.object_distance
    return MeritFunction(own, variables, quality, operands.entries)


@torch.no_grad()
def noise_of(readout: Readout) -> float:
    """Return the variance of a pixel of mean grey, in linear light, as it is read out."""
    grey: Tensor = torch.full((1, 1, 3, _PROBE, _PROBE), _GREY)
    read = readout.develop(readout(grey, torch.Generator().manual_seed(0)))
    return max(float(read.var(dim=(-2, -1)).mean()), _LEAST_NOISE)
