"""Functions become operators of PyTorch's dispatcher, with shapes and derivatives."""

from collections.abc import Callable
from typing import Any

import torch

from dolens.errors import InputError

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
