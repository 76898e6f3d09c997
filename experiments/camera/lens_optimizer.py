"""A camera's lens is moved by gradients or by damped least squares, in turns with its network."""

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.experiments.camera.lens_merit import (
    CameraOperands,
    DeconvolvedDesign,
    design_for_deconvolution,
)
from dolens.experiments.camera.views.base import Imaging
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import to_file_units
from dolens.optimize.trust_region_step import ray_moves, trust_region_step
from dolens.optimize.variables import DesignVariables
from dolens.tasks import stage as named_stage
from dolens.typed_values import call_with_settings

logger = logging.getLogger(__name__)

# Where the slope along the last step has kept more than this part of itself, rays may move farther
# the next time, and where it has turned round less far.
_STEADY, _LONGER, _SHORTER = 0.5, 1.25, 0.7
# Never less far than this part of the first step.
_MIN_TRUST_RADIUS = 0.02


class CameraOptimizer:
    """Makes the optimizer of a camera's network, and chooses the one of its lens.

    Args:
        network: parameter groups → optimizer.
        lens: `adam`: the lens's variables are a group of the same optimizer (whichever it is);
            `dls`: damped least squares, in turns with it.
        least_squares: settings of `LensLeastSquares`.
        until: share of the training steps after which the lens stands still, and no derivative of
            it is computed.

    Raises:
        InputError: an unknown choice, or a setting that least squares cannot have.
    """

    def __init__(
        self,
        network: Callable[..., torch.optim.Optimizer],
        lens: str = "adam",
        least_squares: Mapping[str, Any] | None = None,
        until: float = 1.0,
    ) -> None:
        check_choice(lens, ("adam", "dls"), "optimizer.lens")
        if not 0.0 <= until <= 1.0:
            raise InputError(f"optimizer.until: {until}; allowed: 0 to 1")
        if "lr" in getattr(network, "keywords", {}):
            message = "nothing reads it; learning_rates.network is the rate"
            raise InputError(f"optimizer.network.lr: {message}")
        self.until = float(until)
        self.network = network
        # Settings of what another choice would use are checked as well.
        where = "optimizer.least_squares"
        steps = call_with_settings(LensLeastSquares, least_squares or {}, where)
        self.lens_steps = steps if lens == "dls" else None

    def __call__(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Return the optimizer of parameter groups."""
        return self.network(groups)


class LensLeastSquares:
    """Moves a lens once for some steps of the network, by the gradient gathered in them.

    The step minimises the loss's linear model and the operands while rays move no farther than
    a trust radius; see `trust_region_step`.  Batches are small and differ, so that a trial on one
    of them would tell little; the next gradient, of other batches, tells how the last step was:
    where the loss still falls along it, rays may move farther, and where it rises less far.

    Args:
        every: steps of the network between two of the lens.
        trust_radius: how far rays may move in the first step, RMS over spots, pixels.
        max_trust_radius: how far they may move in any later one.
        first_iterations: of damped least squares for the deconvolved error, before the network
            begins to train; see `dolens.optimize.deconvolved_error`.  0: none.
        first_damping: their initial damping: the larger, the nearer is the minimum that is found.
        strength: share of the best linear filter that the network is thought to find; None: 1 of
            a network that is given point spread functions, 0 of another.

    Rarely needed:
        damping: of variables that undo one another.
        rings: of rays in a pupil.
        arms: of rays in a pupil, even.

    Raises:
        InputError: a number that is out of range.
    """

    def __init__(
        self,
        every: int = 5,
        trust_radius: float = 0.1,
        max_trust_radius: float = 0.5,
        first_iterations: int = 0,
        first_damping: float = 1e-3,
        strength: float | None = None,
        damping: float = 1e-3,
        rings: int = 4,
        arms: int = 8,
    ) -> None:
        for name, value in (
            ("every", every),
            ("trust_radius", trust_radius),
            ("first_damping", first_damping),
            ("damping", damping),
        ):
            if not 0.0 < value < math.inf:
                raise InputError(f"optimizer.least_squares.{name}: {value}; allowed: above 0")
        if not max_trust_radius >= trust_radius:
            raise InputError(
                f"optimizer.least_squares.max_trust_radius: {max_trust_radius}; allowed: from "
                f"trust_radius, {trust_radius}, on"
            )
        if first_iterations < 0:
            raise InputError(
                f"optimizer.least_squares.first_iterations: {first_iterations}; allowed: 0 or more"
            )
        if strength is not None and not 0.0 <= strength <= 1.0:
            raise InputError(
                f"optimizer.least_squares.strength: {strength}; allowed: null, or 0 to 1"
            )
        self.first_iterations, self.strength = int(first_iterations), strength
        self.first_damping = float(first_damping)
        self.every, self.damping = int(every), float(damping)
        self.rings, self.arms = int(rings), int(arms)
        self.trust_radius, self.max_trust_radius = float(trust_radius), float(max_trust_radius)
        self.min_trust_radius = _MIN_TRUST_RADIUS * self.trust_radius
        self.taken = 0
        self._gathered: Tensor | None = None
        self._last: Tensor | None = None
        self._slope = 0.0

    def is_due(self, steps: int) -> bool:
        """Return whether the lens moves after so many steps of the network."""
        return steps % self.every == 0

    def gather(self, variables: DesignVariables) -> None:
        """Add the gradient of a step of the network to those before, and take it away."""
        gradient, variables.scaled.grad = variables.scaled.grad, None
        if gradient is not None:
            before = torch.zeros_like(gradient) if self._gathered is None else self._gathered
            self._gathered = before + gradient / self.every

    @torch.no_grad()
    def step(
        self,
        lens: Lens,
        variables: DesignVariables,
        spots: list[SpotRays],
        pitch: float,
        operands: CameraOperands | None = None,
        share: float = 1.0,
    ) -> dict[str, float]:
        """Make one step by the gradient that was gathered, and forget that gradient.

        Args:
            lens: where the values are stored.
            variables: u.
            spots: rays of the lens.
            pitch: of the pixels, mm.
            operands: what the lens must be besides; the gradient is without them.
            share: of the trust radius, as a schedule has it.

        Returns:
            Numbers to log: `trust_radius`, the trust radius (pixels); `slope_kept` by the last
            step; `moved` (RMS, pixels).

        Raises:
            UnreachableField: a chief ray that operands ask for does not reach the stop.
        """
        gathered, self._gathered = self._gathered, None
        if gathered is None or not share > 0.0:
            return {}
        gradient = gathered.double().cpu()
        if not bool(torch.isfinite(gradient).all()):
            logger.warning("the lens's gradient is not finite: it does not move this time")
            return {}
        numbers = {}
        if self._last is not None and self._slope < 0.0:
            kept = float(gradient @ self._last) / self._slope
            if kept > _STEADY:
                self.trust_radius = min(_LONGER * self.trust_radius, self.max_trust_radius)
            elif kept < 0.0:
                self.trust_radius = max(_SHORTER * self.trust_radius, self.min_trust_radius)
            numbers["slope_kept"] = kept
        scaled, point = variables.scaled, variables.scaled.detach().double().cpu()
        moves = ray_moves(lens, variables, spots, self.damping)
        lower, upper = (b.double().cpu() - point for b in (variables.lower, variables.upper))
        step = trust_region_step(
            gradient,
            moves,
            self.trust_radius * share * pitch,
            lower.clamp(max=0.0),
            upper.clamp(min=0.0),
            None if operands is None else operands.model(lens, variables),
        )
        scaled.copy_(point + step)
        variables.project()
        variables.write_to(lens)
        self.taken += 1
        self._last, self._slope = step, float(gradient @ step)
        return numbers | {"reach": self.trust_radius, "moved": float((moves @ step).norm()) / pitch}

    def reject(self) -> None:
        """Move rays less far the next time: the lens cannot be judged after the last step."""
        self.trust_radius = max(_SHORTER * self.trust_radius, self.min_trust_radius)
        self._last, self._slope = None, 0.0

    def numbers(self) -> dict[str, float]:
        """Return how many steps were taken, and how far rays may move now (pixels)."""
        return {"lens_steps/taken": float(self.taken), "lens_steps/reach": self.trust_radius}

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint keeps, the gradient gathered so far included."""
        return {
            "trust_radius": self.trust_radius,
            "taken": self.taken,
            "gathered": None if self._gathered is None else self._gathered.clone(),
            "last": None if self._last is None else self._last.clone(),
            "slope": self._slope,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what a checkpoint kept."""
        self.trust_radius, self.taken = float(state["trust_radius"]), int(state["taken"])
        self._gathered, self._last = state["gathered"], state["last"]
        self._slope = float(state["slope"])


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
        operands.check(lens.with_values(variables()))

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
        return self.operands.penalty(self.lens.with_values(values))

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
