"""Gradients of a long computation with the memory of a short one (adjoint back-propagation).

The forward pass runs piece by piece without a graph.  The backward pass runs each piece again,
with a graph this time, pushes the output's gradient through it at once and lets it go.  Memory is
bounded by one piece; the price is one more forward pass.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

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
