"""The number of variables decides which optimizer a design takes."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError

ParameterGroups = Iterable[Tensor] | Iterable[dict[str, Any]]


def by_number_of_variables(
    params: ParameterGroups,
    max_variables: int,
    few: Callable[[ParameterGroups], torch.optim.Optimizer],
    many: Callable[[ParameterGroups], torch.optim.Optimizer],
) -> torch.optim.Optimizer:
    """Return an optimizer whose step costs what the problem's size allows (supplement, Section II
    A).

    A step of damped least squares factors a matrix with a column for each variable; one of Adam
    costs a gradient, whatever their number.

    Args:
        params: tensors, or groups of them, as every optimizer takes.
        max_variables: variables up to which `few` is taken.
        few: for example damped least squares.
        many: for example Adam.

    Raises:
        InputError: `max_variables` is negative.
    """
    if max_variables < 0:
        raise InputError(f"optimizer.max_variables: {max_variables}; allowed: 0 or more variables")
    given: list[Any] = list(params)
    tensors = [
        tensor
        for entry in given
        for tensor in (entry["params"] if isinstance(entry, dict) else [entry])
    ]
    count = sum(tensor.numel() for tensor in tensors)
    return (few if count <= max_variables else many)(given)
