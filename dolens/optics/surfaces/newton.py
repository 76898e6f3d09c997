"""Newton's iteration runs outside any graph and under every torch.func transform."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

MAX_STEPS = 40

Step = Callable[[Mapping[str, Tensor], tuple[Tensor, ...], Tensor], Tensor]
# Of the same arguments: whether t is a root that counts.
Accepts = Callable[[Mapping[str, Tensor], tuple[Tensor, ...], Tensor], Tensor]


class _Root(torch.autograd.Function):
    """The iteration is one operation.

    Its loop ends when all rays have converged, a decision that `vmap` cannot trace; here a batch
    becomes one more leading dimension, and one loop serves it all.  The result has no derivative:
    the caller's own steps inside the graph give it.
    """

    @staticmethod
    def forward(
        step: Step, accepts: Accepts, names: tuple[str, ...], scale: float, *tensors: Tensor
    ) -> Tensor:
        start, *ray = tensors[:6]
        values = dict(zip(names, tensors[6:], strict=True))
        t = _iterated(step, values, tuple(ray), start, scale)
        again = (start != 0.0) & ~accepts(values, tuple(ray), t)
        if bool(again.any()):
            second = torch.where(again, torch.zeros_like(t), t)
            t = torch.where(again, _iterated(step, values, tuple(ray), second, scale), t)
        return t

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)
        ctx.inputs = len(inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, ...]:
        return (None,) * ctx.inputs

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        return None

    @staticmethod
    def vmap(
        info: Any,
        in_dims: tuple[Any, ...],
        step: Step,
        accepts: Accepts,
        names: tuple[str, ...],
        scale: float,
        *tensors: Tensor,
    ) -> tuple[Tensor, int]:
        dims = in_dims[4:]
        size = info.batch_size
        moved = [
            t.movedim(d, 0) if d is not None else t for t, d in zip(tensors, dims, strict=True)
        ]
        batched = [d is not None for d in dims]
        if any(b and t.dim() > 1 for t, b in zip(moved[6:], batched[6:], strict=True)):
            # Arrays (coefficients) differ from lens to lens: their lookup is a lens's own.
            rows = [
                _Root.apply(
                    step,
                    accepts,
                    names,
                    scale,
                    *(t[i] if b else t for t, b in zip(moved, batched, strict=True)),
                )
                for i in range(size)
            ]
            return torch.stack(rows), 0
        rank = max(t.dim() - b for t, b in zip(moved[:6], batched[:6], strict=True))
        ready = []
        for t, b in zip(moved, batched, strict=True):
            if b:
                t = t.reshape(size, *(1,) * (rank - t.dim() + 1), *t.shape[1:])
            ready.append(t)
        # Where the parameters alone differ, the first guess is one for all: it becomes the batch.
        full = torch.broadcast_shapes((size, *(1,) * rank), *(t.shape for t in ready[:6]))
        ready[0] = ready[0].expand(full)
        return _Root.apply(step, accepts, names, scale, *ready), 0


def _iterated(
    step: Step, values: Mapping[str, Tensor], ray: tuple[Tensor, ...], start: Tensor, scale: float
) -> Tensor:
    """Return where Newton's iteration ends; NaN where it still takes its longest steps."""
    epsilon = torch.finfo(start.dtype).eps
    t, change = start.clone(), torch.zeros_like(start)
    for _ in range(MAX_STEPS):
        change = step(values, ray, t).clamp(-scale, scale)
        t = t - change
        # Newton converges quadratically: after a step of √ε the next is below rounding.
        if bool((change.abs() <= math.sqrt(epsilon) * (t.abs() + scale)).all()):
            return t
    return t.masked_fill(~(change.abs() < scale), math.nan)


def find_root(
    step: Step,
    accepts: Accepts,
    parameters: Mapping[str, Tensor],
    start: Tensor,
    ray: tuple[Tensor, ...],
    scale: float,
) -> Tensor:
    """Iterate t ← t - step(parameters, ray, t) until no ray moves; no gradient.

    A ray that ends at no root that counts begins once more at t = 0: where terms undo most of a
    deep conic, its own intersection lies beyond where the polynomial turns.

    Args:
        step: Newton's step F/F_t, elementwise in the rays.
        accepts: whether t is a root that counts, elementwise.
        parameters: name → tensor, as `step` takes them.
        start: first guess, mm.
        ray: five tensors that broadcast with `start`.
        scale: mm; no step is longer, and it sets the tolerance near zero.

    Returns:
        t, mm; NaN where the iteration still takes its longest steps in the end, or has overflowed.
        The caller checks the residual: other rays that have not converged are not marked here.
    """
    names = tuple(parameters)
    tensors = (start, *ray, *parameters.values())
    return _Root.apply(step, accepts, names, scale, *(tensor.detach() for tensor in tensors))
