"""This step of damped least squares needs no more of a lens's loss than its gradient.

A network's loss L has the gradient g_k = ∂L/∂p_k with respect to the intercept p_k of each ray.
With residuals g_k/(2√(κ w_k)) and rows √(κ w_k)·J_k, the rays' own derivatives with respect to the
variables, least squares minimises

    L + g·δ + κ·Σ w_k |J_k δ|²,    g = Σ J_kᵀ g_k = ∂L/∂u,

so that the rays' residuals need not be known one by one: the sum that counts is what back-
propagation through the whole camera gives.  What the rays add is the measure of a step: not how far
variables move but how far rays do, whatever the variables' units and however they work together.
κ, the damping, is what lets rays move as far as they may.

Operands are known better than by their gradient: their residuals and rows are in the sum as they
are.  A steep limit stops the step that meets it, where its gradient would throw the next one back.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optimize.linear_least_squares import LinearModel, bounded_step
from dolens.optimize.merit import OperandModel
from dolens.optimize.variables import DesignVariables

# Of the strongest variable's effect: variables are damped as if they moved rays by no less.
_LEAST_COLUMN = 1e-6
# The damping is sought between what is certainly enough and this part of it, ...
_LEAST_DAMPING = 1e-12
# ... until rays move as far as they may to this part, in no more turns than these.
_CLOSE, _TURNS = 1e-6, 80


def ray_moves(
    lens: Lens, variables: DesignVariables, spots: list[SpotRays], damping: float
) -> Tensor:
    """Return a triangular matrix R (P, P) with |Rδ|² = Σ w |J δ|², mm²: how far a step moves rays.

    Moves count from the centroid of each spot, since an image as a whole may move; spots count
    alike.  Where variables undo one another, Σ damping·(d_j δ_j)² keeps R regular, with d_j what
    variable j alone moves rays by.

    Args:
        lens: as the variables have it.
        variables: u, and what follows from them.
        spots: rays of one or several object distances.
        damping: above 0.
    """
    names, derivatives = variables.derivatives()
    rows = []
    for part in spots:
        found = ray_jacobian(lens, part.rays, names)
        moves = found.derivatives.double().cpu() @ derivatives.cpu()
        moves = torch.where(found.valid.cpu()[:, None, None], moves, 0.0)
        weight, spot = part.weight.cpu(), part.spot.cpu()
        mean = moves.new_zeros((part.count, *moves.shape[1:]))
        mean.index_add_(0, spot, weight[:, None, None] * moves)
        share = (weight / (part.count * len(spots))).sqrt()
        rows.append((share[:, None, None] * (moves - mean[spot])).flatten(0, 1))
    whole = torch.cat(rows)
    columns = torch.linalg.vector_norm(whole, dim=0)
    columns = columns.clamp(min=max(_LEAST_COLUMN * float(columns.amax()), 1e-150))
    damped = torch.cat([whole, torch.diag(damping**0.5 * columns)])
    return torch.linalg.qr(damped, mode="r").R


def trust_region_step(
    gradient: Tensor,
    moves: Tensor,
    trust_radius: float,
    lower: Tensor,
    upper: Tensor,
    operands: OperandModel | None = None,
) -> Tensor:
    """Return the step δ (P,) within bounds that lowers g·δ + Σ (operands' residuals)² most while
    rays move by |Rδ| ≤ `trust_radius`.

    Without operands and bounds it is δ = -trust_radius · M⁻¹g/√(gᵀM⁻¹g) with M = RᵀR.

    Args:
        gradient: g = ∂L/∂u, (P,), without the operands' share.
        moves: R of `ray_moves`.
        trust_radius: RMS, mm, above 0.
        lower: (P,), at most zero: bounds of δ.
        upper: (P,), at least zero.
        operands: where δ = 0; None for none.
    """
    gradient = gradient.detach().double().cpu()
    still = torch.zeros_like(gradient)
    slope = gradient
    if operands is not None:
        model = operands.near(still)
        slope = gradient + 2.0 * model.root.T @ model.right
    # What is minimised is convex, so that |R⁻ᵀ slope|·|Rδ| ≥ -slope·δ ≥ κ|Rδ|².
    enough = float(_in_rays(slope, moves).norm()) / trust_radius
    if not enough > 0.0:
        return still

    def at(damping: float) -> tuple[Tensor, float]:
        step = _damped(gradient, moves, damping, lower, upper, operands)
        return step, float((moves @ step).norm()) / trust_radius

    low, high = math.log(_LEAST_DAMPING * enough), math.log(enough)
    step, moved = at(math.exp(low))
    if moved <= 1.0:
        return step
    step, least = at(enough)
    # Rays move less the more they are damped, in inverse proportion where nothing holds them back.
    far, near = math.log(moved), math.log(max(least, 1e-300))
    for turn in range(_TURNS):
        if abs(near) < _CLOSE:
            break
        middle = low + (high - low) * far / (far - near)
        if turn % 3 == 2 or not low < middle < high:
            middle = 0.5 * (low + high)
        found, moved = at(math.exp(middle))
        if moved > 1.0:
            low, far = middle, math.log(moved)
        else:
            step, high, near = found, middle, math.log(max(moved, 1e-300))
    return step


def _in_rays(gradient: Tensor, moves: Tensor) -> Tensor:
    """Return R⁻ᵀg, of which the rays' residuals are a multiple."""
    return torch.linalg.solve_triangular(moves.T, gradient[:, None], upper=False)[:, 0]


def _damped(
    gradient: Tensor,
    moves: Tensor,
    damping: float,
    lower: Tensor,
    upper: Tensor,
    operands: OperandModel | None,
) -> Tensor:
    """Return the step that minimises g·δ + κ|Rδ|² + Σ (operands' residuals)² within bounds."""
    root = damping**0.5
    rays = LinearModel(0.0, root * moves, 0.5 / root * _in_rays(gradient, moves))
    negligible = 1e-12 * rays.column_norms.square()
    step = torch.zeros_like(gradient)
    if operands is None:
        return bounded_step(rays, negligible, lower, upper).step

    # Which limits are broken follows from the step: quadratic pieces, each solved exactly, until
    # the solution of one lies in it.  On the way there the sum is made least along each line.
    rows = operands.near(step)
    for _ in range(_TURNS):
        model = LinearModel.join([rays, rows])
        towards = bounded_step(model, negligible, lower, upper).step - step

        def slope(share: float, step: Tensor = step, towards: Tensor = towards) -> float:
            there = step + share * towards
            rays = 2.0 * damping * moves.T @ (moves @ there)
            return float((gradient + rays + operands.gradient(there)) @ towards)

        share = 1.0 if slope(1.0) <= 0.0 else _root(slope)
        step = step + share * towards
        piece, rows = rows, operands.near(step)
        same = torch.equal(piece.root, rows.root) and torch.equal(piece.right, rows.right)
        if same or not bool((share * towards).abs().amax() > _CLOSE**2 * step.abs().amax()):
            break
    return step


def _root(slope: Callable[[float], float]) -> float:
    """Return the zero of a function that rises from below zero to above it on [0, 1]."""
    low, high = 0.0, 1.0
    while high - low > 1e-9 * high and high > 1e-18:
        middle = 0.5 * (low + high)
        if slope(middle) > 0.0:
            high = middle
        else:
            low = middle
    return low
