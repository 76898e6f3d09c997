"""Training steps of a camera's lens: operands, bounds, and least squares beside the network."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from dolens.experiments.camera.deconvolved_design import (
    DeconvolvedDesign,
    design_for_deconvolution,
)
from dolens.experiments.camera.lens_least_squares import LensLeastSquares
from dolens.experiments.camera.operands import CameraOperands
from dolens.experiments.camera.views.base import Imaging
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import to_file_units
from dolens.optimize.variables import DesignVariables
from dolens.tasks import stage as named_stage


class LensSteps:
    """Finishes each training step for the lens.

    Its variables move with the network's parameters by the same optimizer, or apart from them by
    damped least squares, once for some steps of the network.

    Args:
        lens: as training begins; the rays of least squares are of this one, so that a resumed run
            measures steps as an uninterrupted one.
        variables: those of the lens.
        operands: what the lens must be besides good for its images.
        views: image the scene.
        least_squares: moves the lens; None: the network's optimizer does.

    Raises:
        InputError: the operands cannot be evaluated where training begins.
    """

    def __init__(
        self,
        lens: Lens,
        variables: DesignVariables,
        operands: CameraOperands,
        views: Imaging,
        least_squares: LensLeastSquares | None,
    ) -> None:
        self.lens, self.variables, self.operands = lens, variables, operands
        self.least_squares = least_squares
        self._pitch = views.sensor.pixel_pitch
        apart = least_squares is not None and len(variables) > 0
        self._spots = views.spots(lens, least_squares.rings, least_squares.arms) if apart else []
        self._views = views
        self.first: DeconvolvedDesign | None = None
        operands.check(lens, variables())

    @property
    def apart(self) -> bool:
        """Return whether the lens moves by least squares, which knows the operands itself."""
        return self.least_squares is not None

    def begin(self, knows_blur: bool, view_norm: float) -> None:
        """Design the lens for its deconvolved error, where least squares are to begin with that.

        Args:
            knows_blur: whether the network is given point spread functions.
            view_norm: p of the power mean of the views' losses.

        Raises:
            InputError: rays fail.
        """
        least_squares = self.least_squares
        if least_squares is None or not len(self.variables) or not least_squares.first_iterations:
            return
        strength = least_squares.strength
        with named_stage("designing the lens for its deconvolved error"):
            self.first = design_for_deconvolution(
                self.lens,
                self.variables,
                self._views,
                self.operands,
                least_squares.first_iterations,
                least_squares.first_damping,
                float(knows_blur) if strength is None else strength,
                view_norm,
            )

    def penalty(self, values: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return what the operands add to the loss, and their values by label."""
        return self.operands.penalty(self.lens, values)

    def finish(
        self, optimizer: torch.optim.Optimizer, before: Tensor, steps: int, share: float
    ) -> dict[str, float]:
        """Move the lens if that is done apart, project its variables (S17), and store them in it.

        Args:
            optimizer: of the network, after its step.
            before: the lens's variables before it.
            steps: that the network has made.
            share: of the trust radius of least squares, as the schedule has it.

        Returns:
            Numbers of a step of least squares; empty without one, and where the lens stands still.
        """
        if not self.variables.scaled.requires_grad:
            return {}
        found: dict[str, float] = {}
        if self.least_squares is not None:
            self.least_squares.gather(self.variables)
            if self.least_squares.is_due(steps):
                found = self.least_squares.step(
                    self.lens,
                    self.variables,
                    self._spots,
                    self._pitch,
                    self.operands,
                    share,
                )
        self.variables.project()
        self.operands.take_back_if_unreachable(
            self.lens, self.variables, before, lambda: self._forget_last_step(optimizer)
        )
        self.variables.write_to(self.lens)
        return found

    def _forget_last_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Drop what led to the last step: Adam's momentum, the trust radius of least squares."""
        optimizer.state.pop(self.variables.scaled, None)
        if self.least_squares is not None:
            self.least_squares.reject()

    def numbers(self) -> dict[str, float]:
        """Return how many steps were taken and taken back."""
        numbers: dict[str, float] = {}
        if self.first is not None:
            numbers["lens_first/deconvolved_error"] = self.first.after
            numbers["lens_first/deconvolved_error_before"] = self.first.before
            numbers["lens_first/iterations"] = float(self.first.iterations)
        if self.operands.entries:
            numbers["lens_steps/taken_back"] = float(self.operands.taken_back)
        return numbers if self.least_squares is None else numbers | self.least_squares.numbers()

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint keeps, by its key there."""
        if self.least_squares is None:
            return {}
        first = None if self.first is None else asdict(self.first)
        return {"dolens_lens_steps": {**self.least_squares.state(), "first": first}}

    def load_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on with what a checkpoint kept."""
        if self.least_squares is not None and "dolens_lens_steps" in checkpoint:
            kept = checkpoint["dolens_lens_steps"]
            self.least_squares.load_state(kept)
            first = kept.get("first")  # checkpoints of old lack it
            self.first = None if first is None else DeconvolvedDesign(**first)


def variable_numbers(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return variables as metrics in the units of files: a number as it is, an array by its RMS."""
    numbers = {}
    for name, value in values.items():
        number = to_file_units(name, value.detach()).float()
        if number.dim() == 0:
            numbers[f"variables/{name}"] = number
        else:
            numbers[f"variables/{name}/rms"] = number.square().mean().sqrt()
    return numbers
