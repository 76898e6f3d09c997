"""Light that lands on a grid of pixels, ray by ray: smooth in where each ray lands."""

import math

import torch
from torch import Tensor


def spline_taps(position: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """The three pixels under a quadratic B-spline at each position, and its values there."""
    centre = torch.round(position.detach())
    d = position - centre
    weights = [0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2]
    index = _index(centre)
    return [index - 1, index, index + 1], weights


def patch_taps(position: Tensor, subpixels: int) -> tuple[list[Tensor], list[Tensor]]:
    """The pixels that a tent at each position covers, and what each integrates of it.

    A tent of half-width w = 1/subpixels, whose middle is e inside the nearest edge of its pixel,
    has (1 - e/w)²/2 beyond that edge while e < w; with w = 1 this is the quadratic B-spline.
    """
    if subpixels == 1:
        return spline_taps(position)
    centre = torch.round(position.detach())
    d = position - centre
    beyond = 0.5 * (1.0 - subpixels * (0.5 - d.abs())).clamp(min=0.0).square()
    index = _index(centre)
    side = torch.where(d.detach() < 0.0, -1, 1)
    return [index, index + side], [1.0 - beyond, beyond]


def _index(centre: Tensor) -> Tensor:
    """Far rays (only invalid ones are) must not overflow the integer."""
    return centre.clamp(-(2.0**30), 2.0**30).long()


def bin_rays(
    rows: Tensor, columns: Tensor, weight: Tensor, height: int, width: int, subpixels: int = 1
) -> Tensor:
    """Bin rays into pixels, each ray as a small smooth patch of light.

    The patch is a tent, one pixel over `subpixels` wide at half its height; what a pixel integrates
    of it is a quadratic B-spline, so that images are once continuously differentiable in where rays
    land, and the sum over all pixels is that of the weights, but for what falls beyond the edges.
    The tent blurs an image: its variance is 1/(6·subpixels²) pixels² along each axis.

    Args:
        rows: (..., N), fractional pixels, counted from the middle of pixel 0; leading dimensions
            have an image each.
        columns: (..., N).
        weight: (..., N); zero leaves a ray out, wherever it lands.
        height: pixels.
        width: pixels.
        subpixels: of which a tent is as wide at half its height, along each side of a pixel.

    Returns:
        (..., height, width).
    """
    shape, points = rows.shape[:-1], rows.shape[-1]
    count = math.prod(shape)
    rows, columns, weight = (t.reshape(count, points) for t in (rows, columns, weight))
    row_taps, row_weights = patch_taps(rows, subpixels)
    column_taps, column_weights = patch_taps(columns, subpixels)
    first = torch.arange(count, device=weight.device)[:, None] * (height * width)
    flat = torch.zeros(count * height * width, dtype=weight.dtype, device=weight.device)
    for row, row_weight in zip(row_taps, row_weights, strict=True):
        for column, column_weight in zip(column_taps, column_weights, strict=True):
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            index = first + torch.where(inside, row * width + column, 0)
            amount = torch.where(inside, weight * row_weight * column_weight, 0.0)
            flat = flat.index_add(0, index.flatten(), amount.flatten())
    return flat.reshape(*shape, height, width)
