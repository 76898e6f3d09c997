"""Textures: where points of a plane lie in them, and lookup between their texels."""

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


def texture_origin(size: tuple[int, int], centre: tuple[float, float]) -> tuple[float, float]:
    """Row and column of the axis in a texture of `size` texels; see `Scene`."""
    (height, width), (row, column) = size, centre
    return 0.5 * (height - 1) - row, 0.5 * (width - 1) - column


def texture_coordinates(
    x: Tensor,
    y: Tensor,
    magnification: float | Tensor,
    pitch: float,
    origin: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """Rows and columns of the texture at points (x, y) mm of the plane.

    The plane is seen from the lens: columns grow with x, rows grow against y.

    Args:
        x: mm.
        y: mm.
        magnification: |image height / object height| of the plane.
        pitch: of the pixels, mm.
        origin: row and column of the axis in the texture, as `texture_origin` has it.
    """
    scale = magnification / pitch
    row, column = origin
    return row - y * scale, column + x * scale


def resized(picture: Tensor, height: int, width: int) -> Tensor:
    """Return a picture (3, h, w) in linear light at another size, as crops of photographs are."""
    if picture.shape[-2:] == (height, width):
        return picture
    size = (height, width)
    found = functional.interpolate(picture[None], size, mode="bicubic", antialias=True)
    return found[0].clamp(0.0, 1.0)
