"""Images that are sums of quadratic B-splines, looked up between their pixels.

The splat's other half: a point reads with the weights by which `splat` would write.
"""

from typing import Any

import torch
from torch import Tensor

from dolens.kernels import splatting
from dolens.rendering.binning import spline_taps
from dolens.rendering.psf import splat


def spline_lookup(images: Tensor, rows: Tensor, columns: Tensor, fused: bool) -> Tensor:
    """Σ over pixels of image · β²(row - i) · β²(column - j) at points.

    Args:
        images: (G, size, size).
        rows: (G, N), fractional pixels; no gradient reaches them.
        columns: (G, N).
        fused: take the CPU's kernel, else PyTorch's operations.

    Returns:
        (G, N); points within a pixel and a half of the edge lack what lies beyond it.
    """
    return _Lookup.apply(images, rows, columns, fused)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(  # noqa: ANN205
        ctx: Any, images: Tensor, rows: Tensor, columns: Tensor, fused: bool
    ):
        ctx.save_for_backward(rows, columns)
        ctx.size, ctx.fused = images.shape[-1], fused
        if fused:
            return splatting.splat_adjoint(rows, columns, torch.ones_like(rows), images)[2]
        return _gather(images, rows, columns)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, columns = ctx.saved_tensors
        return splat(rows, columns, gradient, ctx.size, ctx.fused), None, None, None


def _gather(images: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    size = images.shape[-1]
    flat, total = images.flatten(1), torch.zeros_like(rows)
    column_taps = list(zip(*spline_taps(columns), strict=True))
    for row, row_weight in zip(*spline_taps(rows), strict=True):
        for column, column_weight in column_taps:
            inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
            found = flat.gather(1, torch.where(inside, row * size + column, 0))
            total = total + torch.where(inside, found * (row_weight * column_weight), 0.0)
    return total
