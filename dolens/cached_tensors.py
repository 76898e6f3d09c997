"""Tensors that a process keeps serve every later call, with and without gradients."""

import hashlib
import io
import pickle
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache, wraps
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
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


class _Contents(pickle.Pickler):
    """Writes what tensors and dataclasses hold, and nothing of where or what else they keep."""

    def reducer_override(self, thing: Any) -> Any:
        """Return what is written of a thing, as `pickle` asks for it."""
        if isinstance(thing, Tensor):
            numbers = thing.detach().cpu().contiguous().numpy().tobytes()
            return tuple, ((str(thing.dtype), str(thing.device), tuple(thing.shape), numbers),)
        if isinstance(thing, type | FunctionType) and thing.__module__ != "builtins":
            # Their name says too little: a user may define another class of the same.
            return tuple, ((thing.__module__, thing.__qualname__, id(thing)),)
        if is_dataclass(thing):
            return type(thing), tuple(getattr(thing, field.name) for field in fields(thing))
        return NotImplemented


def _digest(*things: Any) -> bytes:
    written = io.BytesIO()
    _Contents(written).dump(things)
    return hashlib.blake2b(written.getbuffer()).digest()


def kept_by_content(maxsize: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for functions of tensors whose results serve later calls with equal ones.

    Arguments are compared bit by bit, by a digest of what they hold: a lens that is built anew from
    the same numbers is the same.  With gradients, or within a transform of `torch.func`, nothing is
    kept.  Callers must not change what is returned.

    Args:
        maxsize: how many results are kept, those that were asked for last.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        results: OrderedDict[bytes, R] = OrderedDict()

        @wraps(function)
        def kept(*args: P.args, **options: P.kwargs) -> R:
            if torch.is_grad_enabled() or torch._C._are_functorch_transforms_active():
                return function(*args, **options)
            key = _digest(args, options)
            found = results.pop(key, None)
            if found is None:
                with to_be_kept():
                    found = function(*args, **options)
            results[key] = found  # the last
            while len(results) > maxsize:
                results.popitem(last=False)
            return found

        return kept

    return decorate
