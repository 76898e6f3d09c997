"""These functions run the CPU kernels on tensors."""

from collections.abc import MutableMapping

import torch
from torch import Tensor

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.adjoint import adjoint_driver
from dolens.kernels.cpu.forward import forward_driver
from dolens.kernels.cpu.layout import BLOCK
from dolens.kernels.cpu.program import Frame, Program, frame_of
from dolens.kernels.cpu.stored_numbers import StoredNumbers as StoredNumbers
from dolens.kernels.table import SurfaceTable

# Chunks of rays that sums are kept for: enough for any processor's threads.
_CHUNKS = 64
_RAY_GRADIENTS = (jobs.POSITION_GRADIENT, jobs.DIRECTION_GRADIENT)

# Of programs of the same codes, extras and precision, without and with derivatives.
Frames = MutableMapping[bool, Frame]


def trace(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    frames: Frames | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry rays through every step.

    Args:
        table: the lens.
        position: (N, 3), mm, in the table's precision.
        direction: (N, 3), unit vectors.
        which: (N,), int32, each ray's column of `table.indices`, or None for the first.
        frames: where those of the table are kept.

    Returns:
        position (N, 3), direction (N, 3), path length (N,), mm; status (N,), int8; and the surface
        where the ray failed (N,), int16.
    """
    count = position.shape[0]
    out = (
        position.new_empty((count, 3)),
        position.new_empty((count, 3)),
        position.new_empty(count),
        torch.empty(count, dtype=torch.int8),
        torch.empty(count, dtype=torch.int16),
    )
    if count == 0:
        return out
    program = Program(table, derivatives=False, frame=_frame(table, False, frames))
    program.set_rays(position, direction, which)
    # Position, direction, path, status and surface: neighbours in a job.
    program.job[jobs.OUT_POSITION : jobs.OUT_SURFACE + 1] = [tensor.data_ptr() for tensor in out]
    program.run(forward_driver, -(-count // BLOCK))
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
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
    frames: Frames | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """Return the cotangents of rays and table from those of position, direction and path length.

    Args:
        table: as in `trace`, and the rays.
        position: (N, 3).
        direction: (N, 3).
        which: (N,), int32, or None.
        status: (N,), int8, from `trace`: only rays that are valid pass a gradient.
        cotangents: of position (N, 3), direction (N, 3) and path (N,), of any strides, or None.
        wanted: whether gradients of position, direction and indices are needed.
        frames: where those of the table are kept.

    Returns:
        Gradients of position and direction (None where not wanted), and in one tensor those of
        `values` and then of `indices` (zeros where not wanted), float64.
    """
    count = position.shape[0]
    gradients = [
        torch.zeros(count, 3, dtype=position.dtype) if want else None for want in wanted[:2]
    ]
    length = table.values.numel() + table.indices.numel()
    chunk = chunk_size(count)
    chunks = -(-count // chunk)
    sums = torch.zeros(length if chunks == 1 else (chunks, length), dtype=torch.float64)
    if count:
        program = Program(table, derivatives=True, frame=_frame(table, True, frames))
        program.set_rays(position, direction, which)
        job = program.job
        job[jobs.OUT_STATUS] = status.data_ptr()
        for place, gradient in zip(_RAY_GRADIENTS, gradients, strict=True):
            if gradient is not None:
                job[place] = gradient.data_ptr()
        job[jobs.SUMS], job[jobs.SUM_LENGTH], job[jobs.CHUNK] = sums.data_ptr(), length, chunk
        job[jobs.INDEX_SUMS] = int(wanted[2])
        of_position, of_direction, of_path = cotangents
        for place, tensor in (
            (jobs.POSITION_COTANGENT, of_position),
            (jobs.DIRECTION_COTANGENT, of_direction),
            (jobs.PATH_COTANGENT, of_path),
        ):
            if tensor is not None:
                job[place] = tensor.data_ptr()
                job[place + 1 : place + 1 + tensor.dim()] = tensor.stride()
        program.run(adjoint_driver, chunks)
    # PyTorch's sum, which adds pairwise.
    return gradients[0], gradients[1], sums if chunks == 1 else sums.sum(0)


def _frame(table: SurfaceTable, derivatives: bool, frames: Frames | None) -> Frame:
    """Return the frame of a table's programs, and keep it if there is where."""
    frame = None if frames is None else frames.get(derivatives)
    if frame is None:
        frame = frame_of(table, derivatives)
        if frames is not None:
            frames[derivatives] = frame
    return frame
