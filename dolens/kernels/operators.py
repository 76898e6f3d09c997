"""The kernels are PyTorch operators: differentiable, and opaque to torch.compile.

`dolens::trace` and `dolens::trace_adjoint` take a packed table as tensors, so that graphs and saved
programs hold no Python objects of ours.  First derivatives only: a second one says so.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from dolens.errors import InputError
from dolens.kernels.table import LossTable, SurfaceTable

_library = torch.library.Library("dolens", "DEF")


def operator(function: Callable[..., Any]) -> Any:
    """Make a function of tensors the operator `dolens::<its name>`.

    `torch.library.custom_op` does the same, but imports PyTorch's whole compiler with the first
    call (seconds), and makes every call 20 to 50 µs longer.
    """
    schema = torch.library.infer_schema(function, mutates_args=())
    name = function.__name__
    _library.define(name + schema, tags=(torch.Tag.pt2_compliant_tag,))
    _library.impl(name, function, "CompositeExplicitAutograd")
    return getattr(torch.ops.dolens, name).default


def register_shapes(name: str, shapes: Callable[..., Any]) -> None:
    """Give an operator the function that makes empty tensors of its results' shapes."""
    torch.library.register_fake(f"dolens::{name}", shapes, lib=_library)


def register_derivative(
    name: str, backward: Callable[..., Any], setup: Callable[..., None]
) -> None:
    """Give an operator its backward pass, and the function that saves tensors for it."""
    torch.library.register_autograd(f"dolens::{name}", backward, setup_context=setup, lib=_library)


def forbid_derivative(name: str) -> None:
    """Make the derivative of an adjoint, a second derivative, an error that says so."""

    def backward(ctx: Any, *gradients: Any) -> None:
        raise InputError(
            "the fast kernels give first derivatives only; use backend 'reference' for second"
        )

    register_derivative(name, backward, lambda ctx, inputs, output: None)


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


@operator
def trace_losses(
    values: Tensor,
    indices: Tensor,
    numbers: Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    codes: Tensor,
    extras: Tensor,
    steps: Tensor,
    series: int,
    absorbs: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry rays that lose light through a `SurfaceTable`; see `trace`.

    Args:
        numbers: of a `LossTable`, and `steps`, `series` and `absorbs`.

    Returns:
        What `trace` does, and the share of light that is left (N,).
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    losses = LossTable(numbers.contiguous(), steps, series, absorbs)
    return kernels_of(position).trace(table, position, direction, which, losses=losses)


def _trace_losses_shapes(values, indices, numbers, position, *others):  # noqa: ANN001, ANN002, ANN202
    found = _trace_shapes(values, indices, position, *others[:4])
    return (*found, position.new_empty(position.shape[0]))


@operator
def trace_losses_adjoint(
    values: Tensor,
    indices: Tensor,
    numbers: Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    codes: Tensor,
    extras: Tensor,
    steps: Tensor,
    series: int,
    absorbs: bool,
    status: Tensor,
    of_position: Tensor | None,
    of_direction: Tensor | None,
    of_path: Tensor | None,
    of_share: Tensor | None,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the cotangents of values, indices, numbers, position and direction.

    `wanted`: of position, direction, indices and numbers; what is not comes back empty, or zero.
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    losses = LossTable(numbers.contiguous(), steps, series, absorbs)
    position_gradient, direction_gradient, sums = kernels_of(position).sweep(
        *(table, position, direction, which, status),
        (of_position, of_direction, of_path, of_share),
        (wanted[0], wanted[1], wanted[2]),
        losses=losses,
        of_losses=wanted[3],
    )
    empty = position.new_empty((0, 3))
    of_values, of_indices, of_numbers = sums.split(
        [values.numel(), indices.numel(), numbers.numel()]
    )
    return (
        of_values.to(values.dtype, copy=True),
        of_indices.reshape(indices.shape).clone(),
        of_numbers.clone(),
        empty if position_gradient is None else position_gradient,
        empty.clone() if direction_gradient is None else direction_gradient,
    )


def _trace_losses_adjoint_shapes(values, indices, numbers, position, *others):  # noqa: ANN001, ANN002, ANN202
    of_values, of_indices, *of_rays = _trace_adjoint_shapes(values, indices, position, *others)
    return of_values, of_indices, torch.empty_like(numbers), *of_rays


def _setup_losses(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, series, absorbs = inputs
    ctx.how = (series, absorbs)
    _setup(ctx, tuple(tensors), output)


def _backward_losses(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    *inputs, status = ctx.saved_tensors
    given = (*gradients[:3], gradients[5])
    if all(g is None for g in given):
        return (None,) * 11
    needs = ctx.needs_input_grad
    wanted = [needs[3], needs[4], needs[1], needs[2]]
    of_values, of_indices, of_numbers, of_position, of_direction = trace_losses_adjoint(
        *inputs, *ctx.how, status, *given, wanted
    )
    return (
        *(of_values, of_indices, of_numbers),
        of_position if wanted[0] else None,
        of_direction if wanted[1] else None,
        *(None,) * 6,
    )


register_shapes("trace_losses", _trace_losses_shapes)
register_derivative("trace_losses", _backward_losses, _setup_losses)
register_shapes("trace_losses_adjoint", _trace_losses_adjoint_shapes)
forbid_derivative("trace_losses_adjoint")
register_shapes("trace", _trace_shapes)
register_derivative("trace", _backward, _setup)
register_shapes("trace_adjoint", _trace_adjoint_shapes)
forbid_derivative("trace_adjoint")


_PLAIN = frozenset((Tensor, nn.Parameter))


def is_eager(tensors: Iterable[Tensor]) -> bool:
    """Return whether operations on these tensors run at once, and for autograd at most.

    Otherwise a compiler, a tracer, a mode, a transform of torch.func, a batch of gradients or a
    subclass of tensors looks on, and must see operators.
    """
    return are_plain(tuple(tensors)) and not (
        torch.compiler.is_compiling()
        or torch._C._is_tracing()
        or torch._C._len_torch_dispatch_stack()
        or torch._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
    )


def are_plain(tensors: Sequence[Tensor]) -> bool:
    """Return whether these are tensors and parameters of PyTorch's, and no batches of gradients."""
    kinds = {*map(type, tensors)}
    if not kinds <= _PLAIN:
        return False
    return Tensor not in kinds or not any(map(torch._C._functorch.is_legacy_batchedtensor, tensors))
