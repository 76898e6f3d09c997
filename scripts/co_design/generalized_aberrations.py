"""The residuals of Côté, Tseng and Heide drive a co-design's lens, beside dolens's own optimizers.

A loss L with the gradient g at the ray intercepts p is taken for ½|w·(p - p')|² with

    w = |g| / √(2L),    p' = p - 2L·g / |g|²,

which has the loss's own value and gradient at p ("Generalized aberrations for processing-aware
optical design", ACM Trans. Graph. 45(5), 2026).  Points p' beyond the window of a point spread
function are put back on its edge, and w grows so that the value stays.  Levenberg and Marquardt's
method takes one step of these residuals for each batch, between the backward pass and the network's
own step: (JᵀJ + λD²)δ = -Jᵀr with D_j the largest |J_j| met, slowly forgotten.  A trial on the same
batch says whether the step stands, and whether λ falls or grows.

Written anew from the formulae.  Here rays go from the sensor to the scene, and intercepts are
those with the scene in pixels.  The rows of J are those of a quadrature of the same pupils, from
the spots' centroids; as many of them count as rays were drawn.
"""

import math
from contextlib import ExitStack
from typing import Any, NamedTuple

import lightning
import torch
from torch import Tensor

from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.camera.made_lenses import restored_in_parts, training_images
from dolens.optimize.operands import UnreachableField
from dolens.optimize.trust_region_step import ray_moves
from dolens.rendering.plane_points import PlanePoints
from dolens.rendering.psf_grid import watched_points

# Of variables that undo one another, in the rows of J.
_REGULAR = 1e-12
# λ stays within this and its inverse.
_LEAST_DAMPING = 1e-8


class _Rays(NamedTuple):
    """Rays of one call: p with its graph to the lens, and a leaf in its place; both (2, …)."""

    points: Tensor
    leaf: Tensor
    weight: Tensor
    size: int


def residuals(
    loss: float, points: list[Tensor], gradients: list[Tensor], half_widths: list[float]
) -> tuple[float, list[Tensor]]:
    """Return w², and w²·(p - p') for each set of points.

    Args:
        loss: L, above 0.
        points: p, from the middle of their windows.
        gradients: g = ∂L/∂p, not all zero; of the points' shapes.
        half_widths: of the windows, in the points' unit.
    """
    square = sum(float(g.double().square().sum()) for g in gradients)
    wanted = [p - 2.0 * loss / square * g for p, g in zip(points, gradients, strict=True)]
    kept = [q.clamp(-h, h) for q, h in zip(wanted, half_widths, strict=True)]
    # A ray without a gradient asks for nothing, wherever it is.
    kept = [torch.where(g == 0.0, p, q) for p, q, g in zip(points, kept, gradients, strict=True)]
    far = [float((p - q).double().square().sum()) for p, q in zip(points, kept, strict=True)]
    if not sum(far) > 0.0:
        return 0.0, [torch.zeros_like(p) for p in points]
    factor = 2.0 * loss / sum(far)
    return factor, [factor * (p - q) for p, q in zip(points, kept, strict=True)]


class GeneralizedAberrations(lightning.Callback):
    """Moves the lens of a camera whose `optimizer.lens` is dls, once for each batch.

    Args:
        damping: λ of the first step.
        tolerance: a step after which the loss is more than this many times as large is taken back.

    Rarely needed:
        increase: of λ after a loss that grew.
        decrease: of λ after another.
        memory: share of D that is kept where columns have become smaller.

    Attributes:
        taken: steps that stood.
    """

    def __init__(
        self,
        damping: float = 1.0,
        tolerance: float = 1.0,
        increase: float = 2.0,
        decrease: float = 3.0,
        memory: float = 0.99,
    ) -> None:
        self.damping, self.tolerance = damping, tolerance
        self.increase, self.decrease, self.memory = increase, decrease, memory
        self.taken = 0
        self._found: list[_Rays] = []
        self._watching = ExitStack()
        self._batch: tuple[Tensor, int] | None = None
        self._loss, self._columns = math.nan, None

    def _cut(self, seen: PlanePoints, size: int) -> PlanePoints:
        """Cut the graph where rays meet the scene, and remember what was cut."""
        if not (torch.is_grad_enabled() and seen.rows.requires_grad):
            return seen
        points = torch.stack(torch.broadcast_tensors(seen.rows, seen.columns))
        leaf = points.detach().requires_grad_()
        weight = seen.weight.detach()
        self._found.append(_Rays(points, leaf, weight.expand(seen.rows.shape), size))
        return PlanePoints(leaf[0], leaf[1], weight)

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        """Begin to watch where rays meet the scene, and keep the graph from there to the lens."""
        self._watching.enter_context(watched_points(self._cut))
        pl_module.backward = lambda loss, *_, **__: loss.backward(retain_graph=True)
        self._watching.callback(delattr, pl_module, "backward")

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        """Watch no longer."""
        self._watching.close()

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        """Watch no longer: a training that fails has no end."""
        self._watching.close()

    def on_train_batch_start(
        self, trainer: Any, pl_module: Any, batch: Tensor, batch_idx: int
    ) -> None:
        """Remember the batch, and forget the rays of the last one."""
        self._found.clear()
        self._batch = (batch, batch_idx)

    def on_before_backward(self, trainer: Any, pl_module: Any, loss: Tensor) -> None:
        """Remember L."""
        self._loss = float(loss.detach())

    def on_before_optimizer_step(self, trainer: Any, pl_module: Any, optimizer: Any) -> None:
        """Move the lens, unless it stands still."""
        variables = pl_module.variables
        variables.scaled.grad = None
        rays = [r for r in self._found if r.leaf.grad is not None]
        if not variables.scaled.requires_grad or not rays or not self._loss > 0.0:
            return
        gradients = [torch.where(r.weight > 0.0, r.leaf.grad, 0.0) for r in rays]
        if not any(bool(g.any()) for g in gradients):
            return
        factor, pulls = residuals(
            self._loss, [r.leaf.detach() for r in rays], gradients, [0.5 * r.size for r in rays]
        )
        torch.autograd.backward([r.points for r in rays], pulls)
        gradient, variables.scaled.grad = variables.scaled.grad.double().cpu(), None
        self._found.clear()
        if bool(torch.isfinite(gradient).all()) and factor > 0.0:
            drawn = sum(int((r.weight > 0.0).sum()) for r in rays)
            self._move(pl_module, gradient, factor * drawn)

    @torch.no_grad()
    def _move(self, camera: CameraModule, gradient: Tensor, factor: float) -> None:
        """Make a step by Jᵀr (P,); JᵀJ is `factor` times the mean square of rays' moves, pixels."""
        steps, variables = camera.lens_steps, camera.variables
        pitch = camera.views.sensor.pixel_pitch
        before = variables.scaled.detach().clone()
        variables.write_to(camera.lens)
        try:
            moves = ray_moves(camera.lens, variables, steps._spots, _REGULAR) / pitch
            matrix, penalty = factor * moves.T @ moves, 0.0
            operands = steps.operands.model(camera.lens, variables)
            if operands is not None:
                model = operands.near(torch.zeros_like(gradient))
                matrix = matrix + 2.0 * model.root.T @ model.root
                gradient = gradient + 2.0 * model.gradient
                penalty = model.sum_of_squares
            step = self._solved(matrix, gradient)
            variables.scaled.copy_(before.double().cpu() + step)
            variables.project()
            ratio = self._trial(camera) / (self._loss + penalty)
        except UnreachableField:
            ratio = math.inf
        if math.isfinite(ratio) and ratio <= self.tolerance:
            self.taken += 1
        else:
            variables.scaled.copy_(before)
        variables.write_to(camera.lens)
        damping = self.damping / self.decrease if ratio <= 1.0 else self.damping * self.increase
        self.damping = min(max(damping, _LEAST_DAMPING), 1.0 / _LEAST_DAMPING)

    def _solved(self, matrix: Tensor, gradient: Tensor) -> Tensor:
        """Return δ, and remember D."""
        columns = matrix.diagonal().sqrt()
        if self._columns is not None:
            largest = torch.maximum(columns, self._columns)
            columns = self.memory * largest + (1.0 - self.memory) * columns
        self._columns = columns
        least = 1e-12 * float(columns.amax()) + 1e-150
        damped = matrix + self.damping * torch.diag(columns.clamp(min=least).square())
        return -torch.linalg.lstsq(damped, gradient[:, None], driver="gelsd").solution[:, 0]

    def _trial(self, camera: CameraModule) -> float:
        """Return the loss of the same batch, with the operands, where the variables are now."""
        assert self._batch is not None  # a step follows a batch
        batch, number = self._batch
        values = camera.variables()
        share = camera.share_of_step(len(batch), number)
        taken, functions = training_images(camera, camera.manufacture, values, batch, share)
        restored = restored_in_parts(camera, taken, functions)
        terms = camera.loss_over_views(restored, taken.truth.to(restored.dtype), shared=True)
        penalty, _ = camera.lens_steps.penalty(values)
        return float(terms["total"]) + float(penalty)
