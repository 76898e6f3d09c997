"""Numbers that lie scattered in memory make a table's records by one call.

The parameters of a lens are some ten or hundred tensors of one number.  PyTorch takes longer to
join these than to trace a thousand rays.
"""

from array import array
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numba import carray, types
from torch import Tensor

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.compiler import int64_at, real64_at
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import UNBOUNDED
from dolens.kernels.cpu.threads import function_at

_KINDS = {torch.float32: ("float32", np.float32), torch.float64: ("float64", np.float64)}
_DTYPE = Tensor.dtype.__get__  # type: ignore[attr-defined]  # in half the time of a loop

# Places in a sum: addresses of arrays, and their lengths.
CONSTANTS, PLACES, SOURCES, SIGNS, VALUES, ENTRIES, NUMBERS = range(7)
LENGTH = 7


def packer(real: types.Type) -> Callable[..., None]:
    """Compile values = constants, values[places] += signs·numbers[sources], of numbers that are
    told by their addresses.
    """
    at = real_at(real)

    def kernel(sum_, addresses, here):  # noqa: ANN001, ANN202
        s = carray(sum_, LENGTH)
        address, values = carray(int64_at(addresses), UNBOUNDED), carray(at(here), UNBOUNDED)
        constants, signs = carray(at(s[CONSTANTS]), UNBOUNDED), carray(at(s[SIGNS]), UNBOUNDED)
        places = carray(int64_at(s[PLACES]), UNBOUNDED)
        sources = carray(int64_at(s[SOURCES]), UNBOUNDED)
        for i in range(s[VALUES]):
            values[i] = constants[i]
        for i in range(s[ENTRIES]):
            values[places[i]] += signs[i] * carray(at(address[sources[i]]), 1)[0]

    return kernel


def unpacker(real: types.Type) -> Callable[..., None]:
    """Compile numbers = 0, numbers[sources] += signs·values[places], of values in double precision,
    each rounded before.
    """
    at = real_at(real)
    zero = real(0.0)

    def kernel(sum_, of_values, here):  # noqa: ANN001, ANN202
        s = carray(sum_, LENGTH)
        values, numbers = carray(real64_at(of_values), UNBOUNDED), carray(at(here), UNBOUNDED)
        signs = carray(at(s[SIGNS]), UNBOUNDED)
        places = carray(int64_at(s[PLACES]), UNBOUNDED)
        sources = carray(int64_at(s[SOURCES]), UNBOUNDED)
        for i in range(s[NUMBERS]):
            numbers[i] = zero
        for i in range(s[ENTRIES]):
            numbers[sources[i]] += signs[i] * real(values[places[i]])

    return kernel


class StoredNumbers:
    """Records are sums of numbers with signs; see `dolens.optics.records.Records`.

    Args:
        constants: (V,).
        places: (E,), int64.
        sources: (E,), int64.
        signs: (E,), each 1 or -1.
        count: of the numbers.
        dtype: of the numbers and the records.
    """

    def __init__(
        self,
        constants: Tensor,
        places: Tensor,
        sources: Tensor,
        signs: Tensor,
        count: int,
        dtype: torch.dtype,
    ) -> None:
        self.dtype, self._length, self._count = dtype, constants.numel(), count
        self._real, self._kind = _KINDS[dtype]
        # Held: the sum has their addresses.
        self._arrays = (constants.to(dtype), places, sources, signs.to(dtype))
        addresses = map(Tensor.data_ptr, self._arrays)
        self._sum = np.array([*addresses, self._length, len(places), count], dtype=np.int64)
        self._address = self._sum.ctypes.data

    def records(self, scalars: Sequence[Tensor], arrays: Sequence[Tensor]) -> Tensor | None:
        """Return the records (V,) of tensors of no dimension, and of arrays behind them.

        None: the scalars have another precision, or one has no memory.
        """
        addresses = [*map(Tensor.data_ptr, scalars)]
        if 0 in addresses or {*map(_DTYPE, scalars)} != {self.dtype}:
            return None
        flat = [tensor.detach().reshape(-1).to(self.dtype).contiguous() for tensor in arrays]
        for tensor in flat:
            begin, size = tensor.data_ptr(), tensor.itemsize
            addresses += range(begin, begin + size * tensor.numel(), size)
        of_numbers = array("q", addresses)  # of int64
        found = torch.empty(self._length, dtype=self.dtype)
        run = function_at(compiler.compile_driver(packer, self._real))
        run(self._address, of_numbers.buffer_info()[0], found.data_ptr())
        return found

    def cotangents(self, of_values: Tensor) -> Tensor:
        """Return the cotangents of the numbers from those of the records.

        Args:
            of_values: (V,) or more, float64, contiguous.
        """
        found = torch.empty(self._count, dtype=self.dtype)
        run = function_at(compiler.compile_driver(unpacker, self._real))
        run(self._address, of_values.data_ptr(), found.data_ptr())
        return found
