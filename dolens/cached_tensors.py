"""Tensors that a process keeps serve every later call, with and without gradients."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import ParamSpec, TypeVar

import torch
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def to_be_kept() -> Iterator[None]:
    """Make tensors that may be kept, as `cached_tensors` says why."""
    transforms = temporarily_clear_interpreter_stack()
    with transforms, torch.inference_mode(False), torch.no_grad():
        yield


def cached_tensors(maxsize: int | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator as `functools.lru_cache` is, for functions that make tensors.

    A tensor that is made under `torch.inference_mode` can never be saved for a backward pass.  A
    lens that is evaluated in that mode, and then trained by the same process, would fail on one
    that was kept; so the function runs outside of that mode, without a graph, and outside of the
    transforms of `torch.func`, which would wrap what is made within them.

    Args:
        maxsize: how many results are kept; None keeps all.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @lru_cache(maxsize=maxsize)
        @wraps(function)
        def kept(*args: P.args, **options: P.kwargs) -> R:
            with to_be_kept():
                return function(*args, **options)

        return kept  # type: ignore[return-value]  # a wrapper takes what the function takes

    return decorate
