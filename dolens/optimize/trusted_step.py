"""A step of damped least squares for a lens whose loss only its gradient is known of.

A network's loss L has the gradient g_k = ∂L/∂p_k with respect to the landing point p_k of each ray.
With residuals g_k/(2√(κ w_k)) and rows √(κ w_k)·J_k, the rays' own derivatives by the variables,
least squares minimises

    L + g·δ + κ·Σ w_k |J_k δ|²,    g = Σ J_kᵀ g_k = ∂L/∂u,

so that the rays' residuals need not be known one by one: the sum that counts is what back-
propagation through the whole camera gives.  What the rays add is the measure of a step: not how far
variables move but how far rays do, whatever the variables' units and however they work together.
Here κ follows from how far rays may move at once, and that from how well the loss was foretold.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.imaging.spot_rays import SpotRays
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optimize.bounded_step import bounded_step
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.variables import DesignVariables

# Of the strongest variable's effect: variables are damped as if they moved rays by no less.
_LEAST_COLUMN = 1e-6


class TrustedStep(NamedTuple):
    """A step δ (P,) of the variables u, and by how much it should lower the loss."""

    step: Tensor
    predicted: float


def ray_moves(
    lens: Lens, variables: DesignVariables, spots: list[SpotRays], damping: float
) -> Tensor:
    """A triangular matrix R (P, P) with |Rδ|² = Σ w |J δ|², mm²: how far a step moves rays.

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


def trusted_step(
    gradient: Tensor, moves: Tensor, reach: float, lower: Tensor, upper: Tensor
) -> TrustedStep:
    """The step that lowers a loss most while rays move no farther than `reach` (RMS, mm).

    Without bounds it is δ = -reach · M⁻¹g/√(gᵀM⁻¹g) with M = RᵀR; within bounds, what minimises the
    same model there.

    Args:
        gradient: ∂L/∂u, (P,).
        moves: R of `ray_moves`.
        reach: mm, above 0.
        lower: (P,), at most zero: bounds of δ.
        upper: (P,), at least zero.
    """
    gradient = gradient.detach().double().cpu()
    # R⁻ᵀg, of which the rows' residuals are a multiple.
    slope = torch.linalg.solve_triangular(moves.T, gradient[:, None], upper=False)[:, 0]
    norm = float(slope.norm())
    if not norm > 0.0:
        return TrustedStep(torch.zeros_like(gradient), 0.0)
    root = (0.5 * norm / reach) ** 0.5
    model = LinearModel(0.0, root * moves, 0.5 * slope / root)
    negligible = torch.full_like(gradient, 1e-12) * model.column_norms.square()
    step = bounded_step(model, negligible, lower, upper).step
    return TrustedStep(step, model.reduction(step))
