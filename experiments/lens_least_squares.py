"""Damped least squares for a camera's lens, in turns with its network's own optimizer."""

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.spot_rays import SpotRays
from dolens.optics.lens import Lens
from dolens.optimize.trusted_step import ray_moves, trusted_step
from dolens.optimize.variables import DesignVariables

logger = logging.getLogger(__name__)

# A step that gains this part of what was foretold is kept; from the second on rays may move
# farther the next time, and up to the third less far (Nocedal and Wright, algorithm 4.1).
_KEPT, _GOOD, _POOR = 1e-4, 0.75, 0.25


class CameraOptimizer:
    """How a camera's parameters move: its network's by `network`, its lens's by it too or apart.

    Args:
        network: parameter groups → optimizer.
        lens: `adam`: the lens's variables are a group of the same optimizer (whichever it is);
            `dls`: damped least squares, in turns with it.
        least_squares: settings of `LensLeastSquares`.

    Raises:
        InputError: an unknown choice.
    """

    def __init__(
        self,
        network: Callable[..., torch.optim.Optimizer],
        lens: str = "adam",
        least_squares: Mapping[str, Any] | None = None,
    ) -> None:
        if lens not in ("adam", "dls"):
            raise InputError(f"optimizer.lens: '{lens}' is unknown; allowed: adam, dls")
        self.network = network
        self.lens_steps = LensLeastSquares(**(least_squares or {})) if lens == "dls" else None

    def __call__(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """The optimizer of parameter groups."""
        return self.network(groups)


class LensLeastSquares:
    """Moves a lens once for some steps of the network, by the gradient they have gathered.

    The step minimises the loss's linear model while rays move no farther than `reach`; see
    `trusted_step`.  It is tried on the batch at hand: where the loss does not fall the lens stays,
    and rays may move half as far the next time.

    Args:
        every: steps of the network between two of the lens.
        reach: how far rays may move in the first step, RMS over spots, pixels.
        most: and in any later one.
        damping: of variables that undo one another.
        rings: of rays in a pupil.
        arms: of rays in a pupil, even.

    Raises:
        InputError: a number that is out of range.
    """

    def __init__(
        self,
        every: int = 5,
        reach: float = 0.3,
        most: float = 1.0,
        damping: float = 1e-3,
        rings: int = 4,
        arms: int = 8,
    ) -> None:
        for name, value in (("every", every), ("reach", reach), ("damping", damping)):
            if not 0.0 < value < math.inf:
                raise InputError(f"optimizer.least_squares.{name}: {value}; allowed: above 0")
        if not most >= reach:
            raise InputError(
                f"optimizer.least_squares.most: {most}; allowed: from reach, {reach}, on"
            )
        self.every, self.most, self.damping = int(every), float(most), float(damping)
        self.rings, self.arms = int(rings), int(arms)
        self.reach = float(reach)
        self.kept = self.refused = 0
        self._gathered: Tensor | None = None

    def is_due(self, steps: int) -> bool:
        """Whether the lens moves after so many steps of the network."""
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
        loss: Callable[[], float],
    ) -> dict[str, float]:
        """One step, by the gradient that was gathered; it is used up.

        Args:
            lens: where accepted values are stored.
            variables: u.
            spots: of the lens.
            pitch: of the pixels, mm.
            loss: of the variables as they are, always of the same batch.

        Returns:
            Numbers to log: `reach` (pixels), `gain_ratio`, `moved` (RMS, pixels).
        """
        gradient, self._gathered = self._gathered, None
        if gradient is None:
            return {}
        if not bool(torch.isfinite(gradient).all()):
            logger.warning("the lens's gradient is not finite: it does not move this time")
            return {}
        scaled, point = variables.scaled, variables.scaled.detach().clone()
        moves = ray_moves(lens, variables, spots, self.damping)
        lower, upper = (
            (bound - point).double().cpu() for bound in (variables.lower, variables.upper)
        )
        found = trusted_step(
            gradient, moves, self.reach * pitch, lower.clamp(max=0.0), upper.clamp(min=0.0)
        )
        if not found.predicted > 0.0:
            return {}
        before = loss()
        scaled.copy_(point + found.step.to(point))
        variables.project()
        ratio = (before - loss()) / found.predicted
        moved = float((moves @ found.step).norm()) / pitch
        if not ratio > _KEPT:
            scaled.copy_(point)
            self.refused += 1
            moved = 0.0
        else:
            self.kept += 1
        if not ratio > _POOR:
            self.reach *= 0.5
        elif ratio > _GOOD:
            self.reach = min(1.5 * self.reach, self.most)
        variables.write_to(lens)
        return {"reach": self.reach, "gain_ratio": ratio, "moved": moved}

    def numbers(self) -> dict[str, float]:
        """How many steps were kept and refused."""
        return {"lens_steps/kept": float(self.kept), "lens_steps/refused": float(self.refused)}

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps, the gradient gathered so far included."""
        gathered = None if self._gathered is None else self._gathered.clone()
        return {
            "reach": self.reach,
            "kept": self.kept,
            "refused": self.refused,
            "gathered": gathered,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        self.reach, self.kept = float(state["reach"]), int(state["kept"])
        self.refused, self._gathered = int(state["refused"]), state["gathered"]
