"""How much a lens expects of other glasses: a quadratic model from its residuals' Jacobian.

With residuals r and the Jacobian J with respect to everything, variables and coordinates of all
glasses, the squared merit near a design is |r + J s|².  For one glass moved by δ, the step of all
that is free is the one that makes this smallest (a Schur complement), and what remains is
2 b·δ + δ·H δ.
"""

import torch
from torch import Tensor

from dolens.lens_search.glass.designs import GlassModel

# Share of the largest diagonal element added to what is eliminated, which may be singular.
_RIDGE = 1e-12


def glass_models(
    gram: Tensor, gradient: Tensor, free: Tensor, shape: tuple[int, int]
) -> GlassModel:
    """Return the model of each glass of a batch of designs.

    Args:
        gram: JᵀJ, (T, N, N), of N = V + G C unknowns, those of the glasses last.
        gradient: Jᵀr, (T, N).
        free: (T, N), which unknowns are optimised again when a glass moves; those of the glass
            itself are never, and variables at a bound had better not be.
        shape: G and C.
    """
    glasses, count = shape
    first = gram.shape[-1] - glasses * count
    slopes, curvatures = [], []
    for glass in range(glasses):
        own = torch.zeros_like(free[0])
        own[first + glass * count : first + (glass + 1) * count] = True
        others = free & ~own
        slope, curvature = _eliminated(gram, gradient, own, others)
        slopes.append(slope)
        curvatures.append(curvature)
    return GlassModel(torch.stack(slopes, 1), torch.stack(curvatures, 1))


def _eliminated(
    gram: Tensor, gradient: Tensor, own: Tensor, others: Tensor
) -> tuple[Tensor, Tensor]:
    """Return gradient and Gram matrix of one glass with the free others eliminated."""
    mask = others.to(gram)
    diagonal = gram.diagonal(dim1=1, dim2=2)
    ridge = _RIDGE * (diagonal * mask).amax(1, keepdim=True) + torch.finfo(gram.dtype).tiny
    # Rows and columns of what is held become those of the unit matrix.
    among = gram * mask[:, :, None] * mask[:, None, :] + torch.diag_embed(
        torch.where(others, ridge, torch.ones_like(mask))
    )
    across = gram[:, :, own] * mask[:, :, None]
    right = torch.cat([across, (gradient * mask)[..., None]], dim=2)
    solved = torch.linalg.solve(among, right)
    change = across.transpose(1, 2) @ solved
    return gradient[:, own] - change[..., -1], gram[:, own][:, :, own] - change[..., :-1]
