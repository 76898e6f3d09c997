"""Least squares for any loss of the points where rays land.

A loss L(p) of landing points p has the gradient g = ∂L/∂p for each ray.  With rows √(κ·w)·J and
residuals g/(2·√(κ·w)) the step of damped least squares minimises

    L + g·Jδ + κ·Σ w·|(J - J̄)δ|²,

the loss's own gradient with the curvature of the spots' size (Côté, Tseng and Heide, "Generalized
transverse ray aberrations", ACM Trans. Graph. 2026).  κ is the loss's own second derivative along
the step that it leads to, over that of the spots' size, so that model and loss curve alike there.
For the squared spot radius κ = 1, and the step is the classical one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.rays import TracedRays
from dolens.optimize.image_quality import ImageQuality
from dolens.optimize.linear_model import LinearModel

# κ is kept within these of what makes the gradient's own step as long as the spots are wide.
_LEAST_CURVATURE = 1e-3


@dataclass(frozen=True)
class Spots:
    """Rays by spots, as a loss of landing points sees them.

    Attributes:
        weight: (N,), share of every ray in its group; they sum to one over each.
        group: (N,), int64, which group a ray belongs to: a spot, or all of a field.
        group_weights: (G,), they sum to one.
    """

    weight: Tensor
    group: Tensor
    group_weights: Tensor


class LandingPointLoss(Protocol):
    """A smooth scalar of where rays land, twice differentiable."""

    def __call__(self, points: Tensor, spots: Spots) -> Tensor:
        """Of deviations (2, N), mm, from their groups' references."""
        ...


@dataclass(frozen=True)
class LossResiduals(ImageQuality):
    """A loss of the landing points as the rays' residuals.

    Args:
        landing_loss: of deviations from the reference.
    """

    landing_loss: LandingPointLoss | Callable[[Tensor, Spots], Tensor] | None = None

    unit: ClassVar[str] = "loss"
    focusable: ClassVar[bool] = False

    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        direction = hit.direction.double()
        points = self._referenced(hit.position[:, :2].double().T)
        return points, (direction[:, :2] / direction[:, 2:]).T

    def _slopes(self, growth: Tensor) -> Tensor:
        return self._referenced(growth)

    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        found = ray_jacobian(lens, self.spots.rays, names)
        rows = torch.cat([found.values.T[None], found.derivatives.permute(2, 1, 0)])
        return self._referenced(rows.double())

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> tuple[LinearModel, Tensor | None]:
        """R and b; ‖b‖² is not the loss, whose value a merit function asks for apart."""
        rows = self._rows(lens, names)
        points, jacobian = rows[0], rows[1:].flatten(1).T
        root = self.ray_weights.sqrt().repeat(2)
        gradient, second = self._derivatives(points)
        # Rays that weigh nothing (chief rays) are no rows.
        own = torch.where(root > 0.0, 0.5 * gradient.reshape(-1) / root, 0.0)
        model = LinearModel.of_rows(own, root[:, None] * jacobian)
        curvature = self._curvature(model, jacobian, root, second, points)
        scaled = model.scaled(curvature**0.5)
        right = model.right / curvature**0.5
        return LinearModel(scaled.sum_of_squares, scaled.root, right), None

    def _derivatives(self, points: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """∂L/∂p (2, N), and L's second derivative along a displacement (2, N) of the rays."""
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            loss = self._loss(points)
            (gradient,) = torch.autograd.grad(loss, points, create_graph=True)

        def along(displacement: Tensor) -> Tensor:
            (product,) = torch.autograd.grad(gradient, points, displacement, retain_graph=True)
            return (product * displacement).sum()

        return gradient.detach(), along

    def _curvature(
        self,
        model: LinearModel,
        jacobian: Tensor,
        root: Tensor,
        second: Callable[[Tensor], Tensor],
        points: Tensor,
    ) -> float:
        """κ along the step of Gauss and Newton with κ = 1, whose direction does not depend on κ."""
        norms = model.column_norms.clamp(min=1e-30)
        # Weakly damped, or directions that move no ray would rule.
        damped = torch.cat([model.root, torch.diag(1e-4 * norms)])
        right = torch.cat([model.right, torch.zeros_like(norms)])
        step = -torch.linalg.lstsq(damped, right[:, None]).solution.squeeze(1)
        moved = jacobian @ step
        size = float((root * moved).square().sum())
        slope = -float(model.gradient @ step)
        if size == 0.0 or slope <= 0.0:
            return 1.0
        own = 0.5 * float(second(moved.reshape(2, -1))) / size
        # Where the loss is flat or concave along it, no step is longer than the spots are wide.
        width = float((root * points.reshape(-1)).square().sum())
        least = slope / max((size * width) ** 0.5, 1e-300)
        return max(own, _LEAST_CURVATURE * least) if own > 0.0 else least

    def _loss(self, deviations: Tensor) -> Tensor:
        weight, group = self.group_shares, self.group
        total = weight.new_zeros(self.spots.count).index_add(0, group, self.ray_weights)
        return self.landing_loss(deviations, Spots(weight, group, total))
