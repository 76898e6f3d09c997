"""The yield is the share of the lenses that are made well enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError


@dataclass(frozen=True)
class Yield:
    """Holds the spot sizes of K lenses.

    Attributes:
        rms: (K,), mm, ascending: √(Σ W·RMS²) over the spots; infinite for a lens that fails.
        worst: (K,), mm, ascending on its own: RMS radius of each lens's worst spot.
    """

    rms: Tensor
    worst: Tensor

    @staticmethod
    def of(mean_squares: Tensor, weights: Tensor) -> "Yield":
        """Return the yield of RMS² of every spot, (K, S), mm², with the spots' weights (S,), which
        sum to one.

        Spots of weight zero count neither in the one nor in the other.
        """
        counted = weights > 0.0
        squares = mean_squares[:, counted]
        overall = (squares * weights[counted]).sum(-1).sqrt()
        return Yield(overall.sort().values, squares.amax(-1).sqrt().sort().values)


def share_within(ascending: Tensor, limit: float) -> float:
    """Return the share of lenses whose RMS (K, sorted) is at most a limit, in the same unit."""
    found = torch.searchsorted(ascending, torch.tensor(limit).to(ascending), right=True)
    return int(found) / len(ascending)


def quantiles(ascending: Tensor, shares: Sequence[float]) -> list[float]:
    """Return, for each share of the lenses, the least RMS (K, sorted) that so many of them stay
    within.

    Raises:
        InputError: a share outside 0 to 1.
    """
    for share in shares:
        if not 0.0 < share <= 1.0:
            raise InputError(f"quantiles lie above 0 and up to 1, not at {share}")
    count = len(ascending)
    # Less than a rounding, or 0.9·10 would count as more than nine.
    return [float(ascending[math.ceil(share * count - 1e-9) - 1]) for share in shares]
