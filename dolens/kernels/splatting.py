"""The splat as PyTorch operators: `dolens::splat` and `dolens::splat_adjoint`."""

from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError


def _backend(points: Tensor) -> Any:
    """The module that splats where the points are; imported when it is first needed."""
    if points.device.type != "cpu":
        raise InputError(f"no fused splat on {points.device}; use backend 'reference'")
    from dolens.kernels.cpu.rendering import splat_backend

    return splat_backend


@torch.library.custom_op("dolens::splat", mutates_args=())
def splat(rows: Tensor, columns: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sum weighted quadratic B-splines, centred on points, onto a grid of pixels.

    Args:
        rows: (N,), fractional pixels.
        columns: (N,).
        weight: (N,).
        size: pixels along each side.

    Returns:
        (size, size), bitwise the same for the same points.
    """
    points = (t.contiguous() for t in (rows, columns, weight))
    return _backend(rows).splat(*points, size)


@splat.register_fake
def _(rows, columns, weight, size):  # noqa: ANN001, ANN202
    return rows.new_empty((size, size))


@torch.library.custom_op("dolens::splat_adjoint", mutates_args=())
def splat_adjoint(
    rows: Tensor, columns: Tensor, weight: Tensor, of_grid: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cotangents of rows, columns and weight, (N,), from that of the grid."""
    tensors = (t.contiguous() for t in (rows, columns, weight, of_grid))
    return _backend(rows).splat_adjoint(*tensors)


@splat_adjoint.register_fake
def _(rows, columns, weight, of_grid):  # noqa: ANN001, ANN202
    return torch.empty_like(rows), torch.empty_like(rows), torch.empty_like(rows)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])


def _backward(ctx: Any, of_grid: Tensor) -> tuple[Tensor | None, ...]:
    return (*splat_adjoint(*ctx.saved_tensors, of_grid), None)


splat.register_autograd(_backward, setup_context=_setup)


def _no_second_derivative(ctx: Any, *gradients: Tensor | None) -> None:
    raise InputError(
        "the fused splat gives first derivatives only; use backend 'reference' for second"
    )


splat_adjoint.register_autograd(
    _no_second_derivative, setup_context=lambda ctx, inputs, output: None
)
