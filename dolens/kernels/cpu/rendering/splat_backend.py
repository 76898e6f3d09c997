"""These functions run the splat on tensors."""

import numpy as np
import torch
from torch import Tensor

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.program import REAL
from dolens.kernels.cpu.rendering import splat as layout
from dolens.kernels.cpu.rendering.splat import splat_adjoint_driver, splat_driver
from dolens.kernels.cpu.threads import spread, thread_count

# Chunks of points of a grid that have a grid of their own.
_CHUNKS, _SMALLEST = 16, 4096


def splat(rows: Tensor, columns: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sum weighted quadratic B-splines at points (G, N) onto grids (G, size, size)."""
    job, chunks = _job(rows, columns, weight, size)
    count = rows.shape[0]
    grids = rows.new_zeros((count, chunks, size, size))
    job[layout.GRIDS] = grids.data_ptr()
    _run(splat_driver, job, count * chunks, rows)
    return grids[:, 0].clone() if chunks == 1 else grids.sum(1)


def splat_adjoint(
    rows: Tensor, columns: Tensor, weight: Tensor, of_grid: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cotangents (G, N) of rows, columns and weight from that of the grids (G, size,
    size).
    """
    job, chunks = _job(rows, columns, weight, of_grid.shape[-1])
    job[layout.GRIDS] = of_grid.data_ptr()
    gradients = torch.empty_like(rows), torch.empty_like(rows), torch.empty_like(rows)
    job[layout.OF_ROWS : layout.OF_WEIGHT + 1] = [g.data_ptr() for g in gradients]
    _run(splat_adjoint_driver, job, rows.shape[0] * chunks, rows)
    return gradients


def _job(rows: Tensor, columns: Tensor, weight: Tensor, size: int) -> tuple[np.ndarray, int]:
    """Return the job, and the number of chunks of a grid, at least one."""
    points = rows.shape[1]
    chunk = max(_SMALLEST, -(-points // _CHUNKS))
    chunks = max(1, -(-points // chunk))
    job = np.zeros(layout.SPLAT_JOB, dtype=np.int64)
    job[: layout.WEIGHT + 1] = (rows.data_ptr(), columns.data_ptr(), weight.data_ptr())
    job[layout.POINTS : layout.CHUNKS + 1] = (points, size, chunk, chunks)
    return job, chunks


def _run(driver: compiler.Factory, job: np.ndarray, chunks: int, like: Tensor) -> None:
    function = compiler.compile_driver(driver, REAL[like.dtype])
    # Threads may share a job: it holds no memory to work in.
    spread(function, [job.ctypes.data] * thread_count(like.numel()), chunks)
