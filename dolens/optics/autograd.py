"""Derivatives through autograd: Jacobians of computed numbers, and replay of long computations.

Gradients of a long computation with the memory of a short one (adjoint back-propagation).

The forward pass runs piece by piece without a graph.  The backward pass runs each piece again,
with a graph this time, pushes the output's gradient through it at once and lets it go.  Memory is
bounded by one piece; the price is one more forward pass.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.func import jvp, vmap

# Directions of forward mode that are carried together.
_TOGETHER = 16


def is_transformed() -> bool:
    """Return whether a transform of `torch.func` (vmap, jvp, vjp) is at work."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def jacobian_of(values: Tensor, variables: Sequence[Tensor]) -> Tensor:
    """∂values/∂variables, (N, P), by one batch of N reverse sweeps.

    Args:
        values: (N,), with a graph, which is kept.
        variables: leaves; P numbers in all, each tensor by rows.
    """
    count = len(values)
    found = torch.autograd.grad(
        values,
        list(variables),
        torch.eye(count, dtype=values.dtype, device=values.device),
        is_grads_batched=True,
        allow_unused=True,
        retain_graph=True,
    )
    return torch.cat(
        [
            values.new_zeros(count, variable.numel())
            if jacobian is None
            else jacobian.reshape(count, -1)
            for variable, jacobian in zip(variables, found, strict=True)
        ],
        1,
    )


def jacobian_by_columns(values: Tensor, variables: Sequence[Tensor]) -> Tensor:
    """The same for many numbers of few variables: P sweeps, whatever N.

    The reverse sweep g(v) = Jᵀv is linear in v, so that its own reverse sweep with a unit vector
    e_k is a column, J·e_k: forward mode from reverse mode.

    Args:
        values: (N,), with a graph, which is kept, of operations that can be differentiated twice.
        variables: leaves; P numbers in all, each tensor by rows.

    Raises:
        RuntimeError: an operation has no second derivative.
        InputError: one of ours has none.
    """
    with torch.enable_grad():
        weight = torch.zeros_like(values, requires_grad=True)
        swept = torch.autograd.grad(
            values, list(variables), weight, create_graph=True, allow_unused=True
        )
        found = [
            torch.zeros_like(variable) if part is None else part
            for part, variable in zip(swept, variables, strict=True)
        ]
        flat = torch.cat([part.reshape(-1) for part in found])
    if not flat.requires_grad:
        return values.new_zeros(len(values), len(flat))
    unit = torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
    (columns,) = torch.autograd.grad(
        flat, weight, unit, is_grads_batched=True, retain_graph=True, allow_unused=True
    )
    if columns is None:
        return values.new_zeros(len(values), len(flat))
    return columns.T


def forward_columns(
    function: Callable[[Tensor], Tensor], point: Tensor, chosen: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """A function's value and its derivatives, by forward mode, for some variables at a time.

    Memory is that of the columns and of sixteen sweeps, however long the computation.  Derivatives
    that are carried together share the values: a third of the time of one after the other where
    tensors are small, and three quarters where they are large.

    Args:
        function: of (P,), of operations that have forward derivatives, without one in place.
        point: (P,), without a graph.
        chosen: (P,), bool: where derivatives are asked for, those of the others are zero; None:
            everywhere.

    Returns:
        The value (...) and the derivatives (..., P).
    """
    directions = torch.eye(len(point)).to(point)
    if chosen is not None:
        directions = directions[chosen.to(directions.device)]
    if not len(directions):
        value = function(point)
        return value, value.new_zeros(*value.shape, len(point))

    def sweep(direction: Tensor) -> tuple[Tensor, Tensor]:
        value, columns, *_ = jvp(function, (point,), (direction,))
        return value, columns

    # The value is the same for all directions.
    together: Callable[[Tensor], tuple[Tensor, Tensor]] = vmap(sweep, out_dims=(None, 0))  # type: ignore[arg-type]
    found = [together(some) for some in directions.split(_TOGETHER)]
    value, columns = found[-1][0], torch.cat([part for _, part in found])
    if chosen is None or bool(chosen.all()):
        return value, columns.movedim(0, -1)
    every = columns.new_zeros(len(point), *value.shape)
    every[chosen.to(columns.device)] = columns
    return value, every.movedim(0, -1)


Piece = Callable[..., Tensor]


def replay(
    piece: Piece,
    sizes: Sequence[int],
    tensors: Sequence[Tensor],
    replayed: Sequence[int] | None = None,
) -> Tensor:
    """Concatenate `piece(i, *tensors)` for i = 0, 1, ... along the last dimension.

    Args:
        piece: a pure function of its index and tensors; run twice it must give the same numbers.
        sizes: length of each piece's last dimension.
        tensors: what it depends on; those that require a gradient receive one.
        replayed: which pieces the backward pass runs (default: all).  When they are drawn at
            random, each equally likely, the gradient, scaled by the number of pieces over the
            number replayed, is an unbiased estimate at a fraction of the cost.

    Returns:
        (..., Σ sizes).
    """
    chosen = range(len(sizes)) if replayed is None else replayed
    return _Replay.apply(piece, tuple(sizes), frozenset(chosen), *tensors)


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(  # noqa: ANN205
        ctx,  # noqa: ANN001
        piece: Piece,
        sizes: tuple[int, ...],
        replayed: frozenset[int],
        *tensors: Tensor,
    ):
        ctx.piece, ctx.sizes, ctx.replayed = piece, sizes, replayed
        ctx.save_for_backward(*tensors)
        return torch.cat([piece(i, *tensors) for i in range(len(sizes))], dim=-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN001
        needed = [i for i, needs in enumerate(ctx.needs_input_grad[3:]) if needs]
        totals: list[Tensor | None] = [None] * len(ctx.saved_tensors)
        scale = len(ctx.sizes) / max(len(ctx.replayed), 1)
        for i, part in enumerate(gradient.split(ctx.sizes, dim=-1)):
            if i not in ctx.replayed:
                continue
            with torch.enable_grad():
                inputs = [t.detach() for t in ctx.saved_tensors]
                for j in needed:
                    inputs[j].requires_grad_()
                output = ctx.piece(i, *inputs)
            if not output.requires_grad:
                continue
            found = torch.autograd.grad(
                output, [inputs[j] for j in needed], scale * part, allow_unused=True
            )
            for j, g in zip(needed, found, strict=True):
                if g is not None:
                    before = totals[j]
                    totals[j] = g if before is None else before + g
        return (None, None, None, *totals)
