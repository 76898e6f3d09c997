"""Numbers that lie scattered in memory are read by one call.

The parameters of a lens are some ten or hundred tensors of one number.  PyTorch takes longer to
join these than to trace a thousand rays.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numba import carray, types
from torch import Tensor

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import UNBOUNDED
from dolens.kernels.cpu.threads import function_at

_KINDS = {torch.float32: ("float32", np.float32), torch.float64: ("float64", np.float64)}


def reader(real: types.Type) -> Callable[..., None]:
    """Compile the reading of `end` numbers, each into the place of its address."""
    at = real_at(real)
    places = 8 // (real.bitwidth // 8)  # in a place of 8 bytes

    def kernel(addresses, here, end):  # noqa: ANN001, ANN202
        address, number = carray(addresses, UNBOUNDED), carray(at(here), UNBOUNDED)
        for i in range(end):
            number[places * i] = carray(at(address[i]), 1)[0]

    return kernel


def read(scalars: Sequence[Tensor]) -> np.ndarray | None:
    """Return the numbers of tensors of no dimension, in their precision.

    None: they have not all the same precision, or one has no memory.
    """
    dtype = scalars[0].dtype
    addresses = [scalar.data_ptr() for scalar in scalars]
    if 0 in addresses or any(scalar.dtype is not dtype for scalar in scalars):
        return None
    name, kind = _KINDS[dtype]
    numbers: Any = np.array(addresses, dtype=np.int64)
    here = numbers.ctypes.data
    function_at(compiler.compile_driver(reader, name))(here, here, len(addresses))
    numbers = numbers.view(kind)
    return numbers[:: len(numbers) // len(addresses)]
