"""Bilinear lookup of textures."""

import torch
from torch import Tensor
from torch.nn import functional


def bilinear(textures: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Look textures up between their texels.

    Args:
        textures: (B, H, W); texel (i, j) is the value at row i, column j.
        rows: (P, S), fractional; beyond the texture its edge goes on.
        columns: (P, S).

    Returns:
        (B, P, S).  Differentiable in the textures and, piecewise, in rows and columns.
    """
    height, width = textures.shape[-2:]
    # One texel has no extent to scale by; every coordinate then reads that texel.
    grid = torch.stack(
        (2.0 * columns / max(width - 1, 1) - 1.0, 2.0 * rows / max(height - 1, 1) - 1.0), -1
    )
    sampled = functional.grid_sample(
        textures[None], grid[None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return sampled[0]
