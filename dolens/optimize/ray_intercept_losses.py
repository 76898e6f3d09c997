"""Losses of the ray intercepts measure modulation, encircled energy or spot size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optimize.loss_residuals import RayGroups


@dataclass(frozen=True)
class SpotSize:
    """Sums W·(RMS radius)², µm²: the classical merit function, as a loss."""

    def __call__(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the loss of ray intercepts (2, N), mm from their groups' references."""
        squares = _over_groups(groups.weight * points.square().sum(0), groups)
        return 1e6 * (groups.group_weights * squares).sum()


@dataclass(frozen=True)
class Modulation:
    """Sums W·(target - MTF)², mean over frequencies, sagittal and tangential lines.

    The geometric modulation transfer function of a spot of ray intercepts p with weights w is
    |Σ w·exp(-2πi·ν·p·e)| for lines across e (Smith, Modern Optical Engineering, 11.9).

    Args:
        frequencies: cycles/mm.
        target: at each frequency; one number for all.

    Raises:
        InputError: no frequency, or one that is not positive, or targets of another number, or
            below zero.
    """

    frequencies: Sequence[float] = (50.0, 100.0)
    target: float | Sequence[float] = 1.0

    def __post_init__(self) -> None:
        if not self.frequencies or not all(f > 0.0 for f in self.frequencies):
            raise InputError(f"frequencies: {self.frequencies}; allowed: positive, cycles/mm")
        if isinstance(self.target, Sequence) and len(self.target) != len(self.frequencies):
            raise InputError("target: give one number, or one for each frequency")
        targets = self.target if isinstance(self.target, Sequence) else (self.target,)
        if not all(0.0 <= target < math.inf for target in targets):
            raise InputError(f"target: {self.target}; allowed: contrasts, 0 or more")

    def __call__(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the loss of ray intercepts (2, N), mm from their groups' references."""
        target = torch.as_tensor(self.target, dtype=points.dtype, device=points.device)
        missed = target.expand(len(self.frequencies))[:, None, None] - self.transfer(points, groups)
        return (groups.group_weights * missed.square()).sum() / (2 * len(self.frequencies))

    def transfer(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the MTF (F, 2, G) of lines across x and across y."""
        frequency = torch.tensor(self.frequencies, dtype=points.dtype, device=points.device)
        phase = 2.0 * math.pi * frequency[:, None, None] * points
        real = _over_groups(groups.weight * phase.cos(), groups)
        imaginary = _over_groups(groups.weight * phase.sin(), groups)
        # Never a root of zero, whose derivative is not finite.
        return (real.square() + imaginary.square() + torch.finfo(points.dtype).tiny).sqrt()


@dataclass(frozen=True)
class EncircledEnergy:
    """Sums W·(share of a spot's light outside a circle about its reference)².

    The circle's edge is smooth: light at distance ρ counts as inside by 1/(1 + exp((ρ - r)/s)).

    Args:
        radius_um: r.
        softness_um: s; None: a quarter of r.

    Raises:
        InputError: a length that is not positive.
    """

    radius_um: float
    softness_um: float | None = None

    def __post_init__(self) -> None:
        if not self.radius_um > 0.0 or not (self.softness_um is None or self.softness_um > 0.0):
            raise InputError("radius_um and softness_um: allowed: positive, µm")

    def __call__(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the loss of ray intercepts (2, N), mm from their groups' references."""
        distance = 1e3 * (points.square().sum(0) + 1e-18).sqrt()
        softness = self.softness_um or 0.25 * self.radius_um
        outside = torch.sigmoid((distance - self.radius_um) / softness)
        return (groups.group_weights * _over_groups(groups.weight * outside, groups).square()).sum()


def _over_groups(values: Tensor, groups: RayGroups) -> Tensor:
    """Return sums (..., G) of values (..., N) over each group."""
    sums = values.new_zeros((*values.shape[:-1], len(groups.group_weights)))
    return sums.index_add(-1, groups.group, values)
