"""The splat is two PyTorch operators: `dolens::splat` and `dolens::splat_adjoint`."""

from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.registration import (
    forbid_derivative,
    operator,
    register_derivative,
    register_shapes,
)


def _backend(points: Tensor) -> Any:
    """Return the module that splats where the points are; it is imported when first needed."""
    if points.device.type != "cpu":
        raise InputError(f"no fused splat on {points.device}; use backend 'reference'")
    from dolens.kernels.cpu.rendering import splat_backend

    return splat_backend


@operator
def splat(rows: Tensor, columns: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sum weighted quadratic B-splines, centred on points, onto a grid of pixels.

    Args:
        rows: (G, N), fractional pixels, for each of G grids.
        columns: (G, N).
        weight: (G, N).
        size: pixels along each side.

    Returns:
        (G, size, size), bitwise the same for the same points.
    """
    points = (t.contiguous() for t in (rows, columns, weight))
    return _backend(rows).splat(*points, size)


def _splat_shapes(rows, columns, weight, size):  # noqa: ANN001, ANN202
    return rows.new_empty((rows.shape[0], size, size))


@operator
def splat_adjoint(
    rows: Tensor, columns: Tensor, weight: Tensor, of_grid: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cotangents of rows, columns and weight, (G, N), from that of the grids."""
    tensors = (t.contiguous() for t in (rows, columns, weight, of_grid))
    return _backend(rows).splat_adjoint(*tensors)


def _splat_adjoint_shapes(rows, columns, weight, of_grid):  # noqa: ANN001, ANN202
    return torch.empty_like(rows), torch.empty_like(rows), torch.empty_like(rows)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])


def _backward(ctx: Any, of_grid: Tensor) -> tuple[Tensor | None, ...]:
    return (*splat_adjoint(*ctx.saved_tensors, of_grid), None)


register_shapes("splat", _splat_shapes)
register_derivative("splat", _backward, _setup)
register_shapes("splat_adjoint", _splat_adjoint_shapes)
forbid_derivative("splat_adjoint")
