"""Derivatives of a few numbers by the tensors that they were computed from."""

from collections.abc import Sequence

import torch
from torch import Tensor


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
