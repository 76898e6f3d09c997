"""The linear ray model predicts the mean effect of tolerances without tracing a lens."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.tolerancing.linear_spots import LinearSpots
from dolens.tolerancing.perturbations import Tolerances


@dataclass(frozen=True)
class Contributions:
    """Holds what each tolerance adds to M = Σ W·RMS², the mean square radius over the spots.

    In the linear ray model M = M₀ + 2g·ε + εᵀQε.  Errors that are independent and zero on average
    raise it on average by Σ Q_pp·σ_p², exactly, and each tolerance's share adds up with the others.

    Attributes:
        names: P parameters.
        nominal: M₀, mm².
        increase: (P,), mm², Q_pp·σ_p²: the average rise of M by one tolerance alone.
        spread: (P,), mm²: the standard deviation of M by one tolerance alone,
            √(4g_p²σ_p² + Q_pp²(E[ε⁴] - σ_p⁴)).
    """

    names: tuple[str, ...]
    nominal: float
    increase: Tensor
    spread: Tensor

    @property
    def share(self) -> Tensor:
        """Return the share (P,) of the average rise; the shares sum to one."""
        total = self.increase.sum()
        return self.increase / torch.where(total > 0.0, total, 1.0)

    @property
    def expected_rms(self) -> float:
        """Return √(M₀ + Σ increase), mm: the nominal RMS and all tolerances' in root sum square."""
        return float((self.nominal + self.increase.sum()).sqrt())

    @property
    def order(self) -> list[int]:
        """Return the columns, the worst offender first."""
        return torch.argsort(self.increase, descending=True, stable=True).tolist()


def contributions(
    model: LinearSpots, tolerances: Tolerances, weights: Tensor, refocused: bool = True
) -> Contributions:
    """Return averages over the tolerances' distributions, in closed form.

    Args:
        model: of the lens as designed, with the tolerances' parameters.
        tolerances: P of them.
        weights: (S,), W of each spot, which sum to one.
        refocused: whether every lens is put at its best focus.  The focus is one more column of
            the least-squares problem, about the best focus of the lens as designed; what it can
            undo is projected out of all others.
    """
    points, mixed, tangents = (
        torch.einsum("s,spq->pq", weights, form)
        for form in (model.points, model.mixed, model.tangents)
    )
    steep = tangents[0, 0]
    if refocused and float(steep) > 0.0:
        shift = -mixed[0, 0] / steep
        points = points + shift * (mixed + mixed.T) + shift.square() * tangents
        mixed = mixed + shift * tangents
        # Half of ∂RMS²/∂focus, as the errors change it: zero for the design.
        focus = torch.cat([mixed[:1, 0], mixed[1:, 0] + mixed[0, 1:]])
        points = points - torch.outer(focus, focus) / steep
    gradient, curvature = points[0, 1:], points.diagonal()[1:]
    variance = tolerances.variance
    excess = (tolerances.fourth_moment - variance.square()).clamp(min=0.0)
    return Contributions(
        model.names,
        float(points[0, 0]),
        curvature * variance,
        (4.0 * gradient.square() * variance + curvature.square() * excess).sqrt(),
    )
