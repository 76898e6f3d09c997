"""Spots through focus show what a compensator can win back."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError


@dataclass(frozen=True)
class FocusCurves:
    """Describes RMS² of spots on a sensor that stands δ (mm) farther from the lens: a + 2b·δ +
    c·δ².

    Rays are straight behind the lens.  A ray lands at d + k·δ from its spot's centroid, with k its
    tangents (l/n, m/n) less their mean, so that with the rays' weights w (which sum to one over a
    spot) a = Σ w·|d|², b = Σ w·d·k and c = Σ w·|k|².

    Attributes:
        mean_square: (..., S), mm², a.
        product: (..., S), mm, b.
        slope_square: (..., S), c.
    """

    mean_square: Tensor
    product: Tensor
    slope_square: Tensor

    def at(self, shift: Tensor | float = 0.0) -> Tensor:
        """Return RMS² (..., S), mm², with the sensor moved by `shift` (..., mm)."""
        if isinstance(shift, Tensor):
            shift = shift[..., None]
        squares = self.mean_square + (2.0 * self.product + self.slope_square * shift) * shift
        # A perfect spot is zero but for rounding.
        return squares.clamp(min=0.0)

    def best_focus(self, weights: Tensor) -> Tensor:
        """Return the shift (...), mm, where Σ W·RMS² is least, δ = -Σ W·b / Σ W·c; zero without
        slopes.

        Args:
            weights: (S,), W of each spot.
        """
        steep = self.slope_square @ weights
        shift = -(self.product @ weights) / torch.where(steep > 0.0, steep, 1.0)
        return torch.where(steep > 0.0, shift, 0.0)


def spot_weights(weights: Tensor | None, spots: int) -> Tensor:
    """Return weights (S,), float64, that sum to one; None stands for equal ones.

    Raises:
        InputError: another number of them, a negative one, or none that is positive.
    """
    if weights is None:
        return torch.full((spots,), 1.0 / spots, dtype=torch.float64)
    weights = torch.as_tensor(weights, dtype=torch.float64)
    if weights.shape != (spots,):
        raise InputError(f"weights: {spots} spots need as many, not {tuple(weights.shape)}")
    if not bool((weights >= 0.0).all()) or not float(weights.sum()) > 0.0:
        raise InputError("weights must not be negative, and one at least positive")
    return weights / weights.sum()
