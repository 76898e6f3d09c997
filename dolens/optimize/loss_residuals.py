"""Any loss of the ray intercepts can be minimised by least squares.

A loss L(p) of ray intercepts p has the gradient g = ∂L/∂p for each ray.  With rows √(κ·w)·J and
residuals g/(2·√(κ·w)) the step of damped least squares minimises

    L + g·Jδ + κ·Σ w·|(J - J̄)δ|²,

the loss's own gradient with the curvature of the spots' size (Côté, Tseng and Heide, "Generalized
transverse ray aberrations", ACM Trans. Graph. 2026).  κ says how much more the loss curves than the
spots' size does.  There are two choices for it:

- `step`: one κ, the ratio of both second derivatives along the step that it leads to;
- `directions`: a κ for each of P directions of the variables, in which the loss's second
  derivative over the ray intercepts, seen through J, and the spots' size are both diagonal.

For the squared spot radius every κ is 1, and the step is the classical one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from dolens.errors import check_choice
from dolens.optics.lens import Lens
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.ray_intercepts import RayInterceptQuality

CURVATURES = ("directions", "step")
# Directions that move rays less than this part of what the strongest does are left out.
_LEAST_MOVE = 1e-10


@dataclass(frozen=True)
class RayGroups:
    """Assigns rays to the groups that share a reference, for losses of ray intercepts.

    Attributes:
        weight: (N,), share of every ray in its group; they sum to one over each.
        group: (N,), int64, which group a ray belongs to: a spot, or all of a field.
        group_weights: (G,), they sum to one.
    """

    weight: Tensor
    group: Tensor
    group_weights: Tensor


class RayInterceptLoss(Protocol):
    """Computes a smooth scalar of the ray intercepts, twice differentiable."""

    def __call__(self, points: Tensor, groups: RayGroups) -> Tensor:
        """Return the loss of deviations (2, N), mm, from their groups' references."""
        ...


@dataclass(frozen=True)
class LossResiduals(RayInterceptQuality):
    """Gives a loss of the ray intercepts a linear model, so that least squares minimises it.

    Args:
        intercept_loss: of deviations from the reference.
        curvature: `directions` or `step`, see above.

    Raises:
        InputError: an unknown curvature.
    """

    intercept_loss: RayInterceptLoss | Callable[[Tensor, RayGroups], Tensor] | None = None
    curvature: str = "directions"

    unit: ClassVar[str] = "loss"
    focusable: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice(self.curvature, CURVATURES, "curvature")

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> tuple[LinearModel, Tensor | None]:
        """Return R and b; ‖b‖² is not the loss, whose value a merit function asks for apart."""
        rows = self._rows(lens, names)
        points, jacobian = rows[0], rows[1:].flatten(1).T
        root = self.ray_weights.sqrt().repeat(2)
        gradient, second = self._derivatives(points)
        # Rays that weigh nothing (chief rays) are no rows.
        own = torch.where(root > 0.0, 0.5 * gradient.reshape(-1) / root, 0.0)
        model = LinearModel.of_rows(own, root[:, None] * jacobian)
        width = float((root * points.reshape(-1)).norm())
        # The model in coordinates z = SVᵀδ, whose unit vectors move the spots by their unit size.
        left, moves, right = torch.linalg.svd(model.root, full_matrices=False)
        kept = moves > _LEAST_MOVE * moves[0].clamp(min=torch.finfo(moves.dtype).tiny)
        left, moves, right = left[:, kept], moves[kept], right[kept]
        slope = left.T @ model.right
        if not bool(kept.any()):
            return model, None
        if self.curvature == "step":
            along = slope / slope.norm().clamp(min=1e-300)
            moved = (jacobian @ (right.T @ (along / moves))).reshape(1, 2, -1)
            own = 0.5 * second(moved).sum()
            directions = torch.eye(len(moves), dtype=moves.dtype)
            # Where the loss is flat or concave, no step is longer than the spots are wide.
            curvature = (own if own > 0.0 else slope.norm() / max(width, 1e-300)).expand_as(moves)
        else:
            moved = (jacobian @ (right.T / moves)).T.reshape(len(moves), 2, -1)
            square = 0.5 * second(moved)
            values, directions = torch.linalg.eigh(0.5 * (square + square.T))
            # A saddle is left downhill both ways; no step is longer than the spots are wide.
            longest = (directions.T @ slope).abs() / max(width, 1e-300)
            curvature = torch.maximum(values.abs(), longest)
        curvature = curvature.clamp(min=1e-12 * float(curvature.amax()) + 1e-300)
        rows = curvature.sqrt()[:, None] * (directions.T @ (moves[:, None] * right))
        right = (directions.T @ slope) / curvature.sqrt()
        return LinearModel(float(right @ right), rows, right), None

    def _derivatives(self, points: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return ∂L/∂p (2, N), and m_iᵀ (∂²L/∂p²) m_j (D, D) as a function of rays' displacements
        m (D, 2, N).  A loss may know the latter itself, as `second_derivatives`.
        """
        own = getattr(self.intercept_loss, "second_derivatives", None)
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad(self._loss(points), points, create_graph=own is None)

        def product(displacements: Tensor) -> Tensor:
            if own is not None:
                with torch.no_grad():
                    return own(points.detach(), self._groups, displacements)
            (found,) = torch.autograd.grad(
                gradient, points, displacements, is_grads_batched=True, retain_graph=True
            )
            return torch.einsum("iaj,kaj->ik", displacements, found)

        return gradient.detach(), product

    def _loss(self, deviations: Tensor) -> Tensor:
        assert self.intercept_loss is not None  # it was checked
        return self.intercept_loss(deviations, self._groups)

    @property
    def _groups(self) -> RayGroups:
        return RayGroups(self.group_shares, self.group, self.group_weights)
