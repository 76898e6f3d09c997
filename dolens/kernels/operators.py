"""The kernels are PyTorch operators: differentiable, and opaque to torch.compile.

`dolens::trace` and `dolens::trace_adjoint` take a packed table as tensors, so that graphs and saved
programs hold no Python objects of ours.  First derivatives only: a second one says so.
"""

from functools import cache
from importlib import import_module
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
from dolens.kernels.table import SurfaceTable


def kernels_of(position: Tensor) -> Any:
    """Return the module that runs kernels where the rays are; it is imported when first needed."""
    return _module(position.device.type, "backend")


def kernels_of_lenses(position: Tensor) -> Any:
    """Return the module that runs kernels of many lenses where the rays are."""
    return _module(position.device.type, "lenses")


@cache
def _module(kind: str, name: str) -> Any:
    if kind not in ("cpu", "cuda"):
        raise InputError(f"no kernels for rays on {kind}; use backend 'reference'")
    return import_module(f"dolens.kernels.{kind}.{name}")


@operator
def trace(
    values: Tensor,
    indices: Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    codes: Tensor,
    extras: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry rays through a `SurfaceTable`, given as its tensors.

    Args:
        values: (V,), in the rays' precision.
        indices: (media, wavelengths), float64.
        position: (N, 3), mm.
        direction: (N, 3), unit vectors.
        which: (N,), int32: each ray's wavelength, or None where there is one.
        codes: (steps, Code.ROW), int64, on the CPU.
        extras: int64, on the CPU.

    Returns:
        position and direction (N, 3), path length (N,), status (N,) int8, surface (N,) int16.
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    return kernels_of(position).trace(table, position, direction, which)


def _trace_shapes(values, indices, position, direction, which, codes, extras):  # noqa: ANN001, ANN202
    count = position.shape[0]
    return (
        position.new_empty((count, 3)),
        position.new_empty((count, 3)),
        position.new_empty(count),
        position.new_empty(count, dtype=torch.int8),
        position.new_empty(count, dtype=torch.int16),
    )


@operator
def trace_adjoint(
    values: Tensor,
    indices: Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    codes: Tensor,
    extras: Tensor,
    status: Tensor,
    of_position: Tensor | None,
    of_direction: Tensor | None,
    of_path: Tensor | None,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the cotangents of values, indices, position and direction.

    `wanted`: of position, direction and indices; what is not comes back empty, or zero.
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    of_rays = kernels_of(position).trace_adjoint(
        table,
        position,
        direction,
        which,
        status,
        (of_position, of_direction, of_path),
        (wanted[0], wanted[1], wanted[2]),
    )
    empty = position.new_empty((0, 3))
    position_gradient, direction_gradient, of_values, of_indices = of_rays
    return (
        of_values,
        of_indices,
        empty if position_gradient is None else position_gradient,
        empty.clone() if direction_gradient is None else direction_gradient,
    )


def _trace_adjoint_shapes(values, indices, position, *others):  # noqa: ANN001, ANN002, ANN202
    wanted = others[-1]
    count = position.shape[0]
    return (
        torch.empty_like(values),
        torch.empty_like(indices),
        position.new_empty((count if wanted[0] else 0, 3)),
        position.new_empty((count if wanted[1] else 0, 3)),
    )


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs, output[3])
    ctx.mark_non_differentiable(output[3], output[4])
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    *inputs, status = ctx.saved_tensors
    if all(g is None for g in gradients[:3]):
        return (None,) * 7
    needs = ctx.needs_input_grad
    wanted = [needs[2], needs[3], needs[1]]
    of_values, of_indices, of_position, of_direction = trace_adjoint(
        *inputs, status, *gradients[:3], wanted
    )
    return (
        of_values,
        of_indices,
        of_position if wanted[0] else None,
        of_direction if wanted[1] else None,
        None,
        None,
        None,
    )


register_shapes("trace", _trace_shapes)
register_derivative("trace", _backward, _setup)
register_shapes("trace_adjoint", _trace_adjoint_shapes)
forbid_derivative("trace_adjoint")
