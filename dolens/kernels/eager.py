"""Kernels may be called without PyTorch's dispatcher where nothing but autograd listens to it."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

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
