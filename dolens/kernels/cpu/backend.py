"""These functions run the CPU kernels on tensors.

Numbers that lie scattered in memory make a table's records by one call.

The parameters of a lens are some ten or hundred tensors of one number.  PyTorch takes longer to
join these than to trace a thousand rays.
"""

from array import array
from collections.abc import Callable, MutableMapping, Sequence

import numpy as np
import torch
from numba import carray, types
from torch import Tensor

from dolens.kernels.cpu import compiler, jobs
from dolens.kernels.cpu.adjoint import adjoint_driver
from dolens.kernels.cpu.compiler import Factory, int64_at, real64_at
from dolens.kernels.cpu.forward import forward_driver, real_at
from dolens.kernels.cpu.layout import BLOCK, UNBOUNDED
from dolens.kernels.cpu.losses import lossy_adjoint_driver, lossy_forward_driver
from dolens.kernels.cpu.program import Frame, Program, frame_of
from dolens.kernels.cpu.threads import function_at
from dolens.kernels.table import LossTable, SurfaceTable

# Chunks of rays that sums are kept for: enough for any processor's threads.
_CHUNKS = 64
_COTANGENTS = (
    jobs.POSITION_COTANGENT,
    jobs.DIRECTION_COTANGENT,
    jobs.PATH_COTANGENT,
    jobs.TRANSMISSION_COTANGENT,
)
_RAY_GRADIENTS = (jobs.POSITION_GRADIENT, jobs.DIRECTION_GRADIENT)

# Of programs of the same codes, extras and precision, without and with derivatives.
Frames = MutableMapping[bool, Frame]


def trace(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    frames: Frames | None = None,
    losses: LossTable | None = None,
) -> tuple[Tensor, ...]:
    """Carry rays through every step.

    Args:
        table: the lens.
        position: (N, 3), mm, in the table's precision.
        direction: (N, 3), unit vectors.
        which: (N,), int32, each ray's column of `table.indices`, or None for the first.
        frames: where those of the table are kept.
        losses: of light, at the table's steps; None: none is asked for.

    Returns:
        position (N, 3), direction (N, 3), path length (N,), mm; status (N,), int8; and the surface
        where the ray failed (N,), int16; with losses also the share of light that is left, (N,).
    """
    count = position.shape[0]
    out = (
        position.new_empty((count, 3)),
        position.new_empty((count, 3)),
        position.new_empty(count),
        torch.empty(count, dtype=torch.int8),
        torch.empty(count, dtype=torch.int16),
        *(() if losses is None else (position.new_empty(count),)),
    )
    if count == 0:
        return out
    program = Program(table, derivatives=False, frame=_frame(table, False, frames, losses))
    program.set_rays(position, direction, which)
    # Position, direction, path, status, surface and share: neighbours in a job.
    end = jobs.OUT_POSITION + len(out)
    program.job[jobs.OUT_POSITION : end] = [tensor.data_ptr() for tensor in out]
    driver: Factory = forward_driver
    if losses is not None:
        program.lose(losses)
        driver = lossy_forward_driver
    program.run(driver, -(-count // BLOCK))
    return out


def chunk_size(count: int) -> int:
    """Return the rays of a chunk, a multiple of the block; it does not depend on the threads."""
    return max(4096, -(-count // (_CHUNKS * BLOCK)) * BLOCK)


def trace_adjoint(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    status: Tensor,
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor, Tensor]:
    """Return the cotangents of rays and table; the arguments are those of `sweep`.

    Returns:
        Gradients of position and direction (None where not wanted), of `values` and of `indices`
        (zeros where not wanted).
    """
    of_position, of_direction, sums = sweep(
        table, position, direction, which, status, cotangents, wanted
    )
    cut = table.values.numel()
    of_values = sums[:cut].to(table.values.dtype, copy=True)
    of_indices = sums[cut:].reshape(table.indices.shape).clone()
    return of_position, of_direction, of_values, of_indices


def sweep(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    status: Tensor,
    cotangents: Sequence[Tensor | None],
    wanted: tuple[bool, bool, bool],
    frames: Frames | None = None,
    losses: LossTable | None = None,
    of_losses: bool = False,
) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """Return the cotangents of rays and table from those of position, direction and path length.

    Args:
        table: as in `trace`, and the rays.
        position: (N, 3).
        direction: (N, 3).
        which: (N,), int32, or None.
        status: (N,), int8, from `trace`: only rays that are valid pass a gradient.
        cotangents: of position (N, 3), direction (N, 3) and path (N,), of any strides, or None;
            with losses a fourth, of the share of light (N,).
        wanted: whether gradients of position, direction and indices are needed.
        frames: where those of the table are kept.
        losses: as in `trace`.
        of_losses: whether gradients of the losses' numbers are needed.

    Returns:
        Gradients of position and direction (None where not wanted), and in one tensor those of
        `values`, then of `indices`, and then of the losses' numbers (zeros where not wanted, none
        without), float64.
    """
    count = position.shape[0]
    gradients = [
        torch.zeros(count, 3, dtype=position.dtype) if want else None for want in wanted[:2]
    ]
    length = inner = table.values.numel() + table.indices.numel()
    length += losses.numbers.numel() if losses is not None else 0
    chunk = chunk_size(count)
    chunks = -(-count // chunk)
    sums = torch.zeros(length if chunks == 1 else (chunks, length), dtype=torch.float64)
    if count:
        program = Program(table, derivatives=True, frame=_frame(table, True, frames, losses))
        program.set_rays(position, direction, which)
        job = program.job
        job[jobs.OUT_STATUS] = status.data_ptr()
        for place, gradient in zip(_RAY_GRADIENTS, gradients, strict=True):
            if gradient is not None:
                job[place] = gradient.data_ptr()
        job[jobs.SUMS], job[jobs.SUM_LENGTH], job[jobs.CHUNK] = sums.data_ptr(), length, chunk
        job[jobs.INDEX_SUMS] = int(wanted[2])
        for place, tensor in zip(_COTANGENTS, cotangents, strict=False):
            if tensor is not None:
                job[place] = tensor.data_ptr()
                job[place + 1 : place + 1 + tensor.dim()] = tensor.stride()
        driver: Factory = adjoint_driver
        if losses is not None:
            program.lose(losses)
            job[jobs.LOSS_SUMS] = inner if of_losses else 0
            driver = lossy_adjoint_driver
        program.run(driver, chunks)
    # PyTorch's sum, which adds pairwise.
    return gradients[0], gradients[1], sums if chunks == 1 else sums.sum(0)


def _frame(
    table: SurfaceTable, derivatives: bool, frames: Frames | None, losses: LossTable | None
) -> Frame:
    """Return the frame of a table's programs, and keep it if there is where."""
    if losses is not None:
        return frame_of(table, derivatives, losses=losses)
    frame = None if frames is None else frames.get(derivatives)
    if frame is None:
        frame = frame_of(table, derivatives)
        if frames is not None:
            frames[derivatives] = frame
    return frame


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
