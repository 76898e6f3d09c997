"""Image quality by ray intercepts, as residuals of least squares: RMS spot radii, and losses such
as spot size, modulation and encircled energy.

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

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.rays import TracedRays
from dolens.optimize.image_quality import ImageQuality
from dolens.optimize.linear_least_squares import LinearModel


class RayInterceptQuality(ImageQuality):
    """Measures image quality by ray intercepts: x and y on the sensor, mm, from the centroid or the
    chief ray.
    """

    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        direction = hit.direction.double()
        points = self._referenced(hit.position[:, :2].double().T)
        return points, (direction[:, :2] / direction[:, 2:]).T

    def _slopes(self, growth: Tensor) -> Tensor:
        return self._referenced(growth)

    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        found = ray_jacobian(lens, self.spots.rays, names)
        # (1 + P, 2, N): neighbouring numbers are those of neighbouring rays.
        rows = torch.cat([found.values.T[None], found.derivatives.permute(2, 1, 0)])
        return self._referenced(rows.double())


# More derivatives than this are summed on the way and never stored (400 MB).
MOST_STORED = 50_000_000


class RayInterceptResiduals(RayInterceptQuality):
    """Gives residuals √(W_s·w_i)·(p_i - p̄_s) of every ray i of every spot s, in µm, x and y apart.

    Their sum of squares is Σ W_s·(RMS radius)².  p̄ is the spot's centroid, or where its chief ray
    lands.  Deviations are in mm.
    """

    scale: ClassVar[float] = 1e3
    unit: ClassVar[str] = "um"

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> tuple[LinearModel, Tensor | None]:
        """Return R and b; see `ImageQuality.linear_model`.  Very many rays are summed, never
        stored.
        """
        columns = sum(parameter.numel() for parameter in lens.variables(names).values())
        many = 2 * len(self.spots.weight) * columns > MOST_STORED
        if many and without is None and self._sums_suffice:
            return self._summed(lens, names), None
        return super().linear_model(lens, names, without)

    @property
    def _sums_suffice(self) -> bool:
        return self.reference == "centroid" and not bool(self.spots.centred.any())

    def _summed(self, lens: Lens, names: Sequence[str]) -> LinearModel:
        sums = normal_equations(
            lens, self.spots.rays, names, weight=self.ray_weights, group=self.group
        ).about_centroids()
        model = LinearModel.of_sums(float(sums.sum_of_squares), sums.jtr, sums.jtj)
        return model.scaled(self.scale)


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
