"""Sensitivities say how spots change with each tolerance alone."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.tolerancing.linear_spots import LinearSpots


@dataclass(frozen=True)
class Sensitivities:
    """Holds the spots of a lens, their derivatives, and their sizes at the ends of each tolerance.

    Where a symmetry makes RMS stationary (a tilt on the axis) its derivative is zero and says
    nothing; what a whole tolerance does tells more.

    Attributes:
        names: P parameters.
        steps: (P,), the tolerances Δ in the lens's units.
        centroid_jacobian: (S, 2, P), mm over the parameter's unit (radians for tilts).
        rms: (S,), mm, as designed.
        rms_jacobian: (S, P), mm over the parameter's unit.
        rms_at_ends: (2, P, S), mm, with the parameter off by -Δ and by +Δ, by the linear ray model.
        rms_refocused: (S,), mm, as designed, at the best focus of all spots.
        rms_at_ends_refocused: (2, P, S), mm: every lens at its own best focus.
        weights: (S,), of the spots; they sum to one.
    """

    names: tuple[str, ...]
    steps: Tensor
    centroid_jacobian: Tensor
    rms: Tensor
    rms_jacobian: Tensor
    rms_at_ends: Tensor
    rms_refocused: Tensor
    rms_at_ends_refocused: Tensor
    weights: Tensor

    @property
    def centroid_shifts(self) -> Tensor:
        """Return how far a whole tolerance moves each spot, (S, 2, P), mm."""
        return self.centroid_jacobian * self.steps

    @property
    def largest_centroid_shift(self) -> Tensor:
        """Return the shift (P,), mm, of the spot that the tolerance moves farthest, of those whose
        weight is not zero.
        """
        return self.centroid_shifts[self.weights > 0.0].norm(dim=1).amax(0)

    def increase(self, refocused: bool = True) -> Tensor:
        """Return how much √(Σ W·RMS²) grows at the worse end of each tolerance, (P,), mm."""
        ends = self.rms_at_ends_refocused if refocused else self.rms_at_ends
        start = self.rms_refocused if refocused else self.rms
        overall = (ends.square() @ self.weights).sqrt().amax(0)
        return overall - (start.square() @ self.weights).sqrt()


def sensitivities(model: LinearSpots, steps: Tensor, weights: Tensor) -> Sensitivities:
    """Return the sensitivities to one tolerance at a time.

    Args:
        model: of the lens as designed.
        steps: (P,), Δ of every parameter, in the lens's units.
        weights: (S,), W of each spot, which sum to one; see `spot_weights`.
    """
    ends = torch.stack([-torch.diag(steps), torch.diag(steps)])
    design = model.focus_curves(torch.zeros_like(steps))
    curves = model.focus_curves(ends)
    return Sensitivities(
        model.names,
        steps,
        model.centroid_jacobian,
        design.at().sqrt(),
        model.rms_jacobian,
        curves.at().sqrt(),
        design.at(design.best_focus(weights)).sqrt(),
        curves.at(curves.best_focus(weights)).sqrt(),
        weights,
    )
