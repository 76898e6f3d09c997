"""A program of derivatives: what the drivers of Jacobians and of least squares run on."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.layout import BLOCK, COTANGENT_HEADER
from dolens.kernels.cpu.program import Program, functions_of
from dolens.kernels.table import Code, Slot, SurfaceTable
from dolens.kernels.variable_map import OUTPUT_ROWS, VariableMap

# Sums are kept for this many chunks, or fewer where they would take more numbers than that.
_CHUNKS, _NUMBERS = 64, 1 << 23

RayTensors = tuple[Tensor, Tensor, Tensor | None]


def rays_of_a_chunk(count: int, length: int) -> int:
    """Return the rays of a chunk, a multiple of the block; it does not depend on the threads."""
    chunks = max(1, min(_CHUNKS, _NUMBERS // length))
    return max(8 * BLOCK, -(-count // (chunks * BLOCK)) * BLOCK)


class Derivatives:
    """A program is held together with the arrays that its job points to while it runs.

    Args:
        table: the lens, up to the sensor.
        variables: P of them.
        outputs: K names of `dolens.kernels.variable_map.OUTPUT_ROWS`.
        rays: position (N, 3), direction (N, 3), and wavelength's column (N,), int32, or None.
        chunk: rays of a chunk.
        further: rows of a block that the driver needs beside the columns.
        index_derivatives: (E, wavelengths), float64, contiguous, for `variables.indices`.
    """

    def __init__(
        self,
        table: SurfaceTable,
        variables: VariableMap,
        outputs: Sequence[str],
        rays: RayTensors,
        chunk: int,
        further: int,
        index_derivatives: Tensor | None = None,
    ) -> None:
        self.program = Program(
            table,
            derivatives=True,
            outputs=len(outputs),
            columns=len(outputs) * variables.count + further,
        )
        self.program.set_rays(*rays)
        job = self.program.job
        job[jobs.OUTPUTS], job[jobs.VARIABLES] = len(outputs), variables.count
        job[jobs.CHUNK] = chunk
        self._seeds = np.array([OUTPUT_ROWS[name] for name in outputs], dtype=np.int64)
        job[jobs.OUTPUT_ROWS] = self._seeds.ctypes.data
        self._entries = _entries(table.codes.numpy().tobytes(), table.values.numel(), variables)
        job[jobs.FIRST_STEP] = self._entries.first_step
        if self._entries.spline is not None:
            job[jobs.SPLINE_COLUMNS] = self._entries.spline.ctypes.data
        names = ("ENTRIES", "ENTRY_ROWS", "ENTRY_COLUMNS", "ENTRY_WEIGHTS", "ENTRY_FIRST")
        for name, array in zip(names, self._entries.arrays, strict=True):
            job[getattr(jobs, name)] = array.ctypes.data
        if variables.indices is not None:
            assert index_derivatives is not None  # they go with the map
            job[jobs.INDEX_ENTRIES] = len(variables.indices.rows)
            job[jobs.INDEX_ROWS] = variables.indices.rows.data_ptr()
            job[jobs.INDEX_COLUMNS] = variables.indices.columns.data_ptr()
            job[jobs.INDEX_WEIGHTS] = index_derivatives.data_ptr()

    def hold(self, weights: Tensor) -> Tensor:
        """Take the weights of many lenses, (L, E), in the place of those of the map.

        Returns:
            The weights as the kernel reads them, which lives as long as this does.
        """
        order, end = self._entries.order, len(self._entries.arrays[1])
        self._weights = torch.zeros((len(weights), end), dtype=torch.float64)
        self._weights[:, : len(order)] = weights[:, torch.from_numpy(order)]
        self.program.job[jobs.ENTRY_WEIGHTS] = self._weights.data_ptr()
        return self._weights


class _Entries(NamedTuple):
    """The drivers take a map of variables in this form.

    Attributes:
        first_step: a sweep ends here, at the first step that any variable belongs to.
        spline: for each number of the table its column, or -1; None without splines' coefficients.
        arrays: where the entries of each step begin; then of each entry the row of the cotangents,
            the column, the weight, and whether it is the first that a sweep brings to its column.
        order: of the entries in `arrays` that come from the map, their places in it.
    """

    first_step: int
    spline: np.ndarray | None
    arrays: tuple[np.ndarray, ...]
    order: np.ndarray


@lru_cache(maxsize=256)
def _entries(codes_: bytes, values: int, variables: VariableMap) -> _Entries:
    """Sort the map by steps; coefficients of splines are looked up by their place instead."""
    codes = np.frombuffer(codes_, dtype=np.int64).reshape(-1, Code.ROW)
    # The last number moves z of the rays only, which is no output.
    kept = variables.places.numpy() < values - 1
    places, columns, weights = (
        array.numpy()[kept] for array in (variables.places, variables.columns, variables.weights)
    )
    steps = np.searchsorted(codes[:, Code.OFFSET], places, side="right") - 1
    rows = places - codes[steps, Code.OFFSET] + COTANGENT_HEADER
    first_step = int(steps.min(initial=codes.shape[0]))
    stencils = np.array(
        [functions_of(int(code)).stencil for code in codes[:, Code.KIND]], dtype=bool
    )
    local = stencils[steps] & (rows >= COTANGENT_HEADER + Slot.HEADER)
    spline = None
    if local.any():
        spline = np.full(values, -1, dtype=np.int64)
        spline[places[local]] = columns[local]
    # By steps; after the last come columns that begin as zero: nothing overwrites them.
    order = np.argsort(steps, kind="stable")
    order = order[~local[order]]
    taken = np.flatnonzero(kept)[order]
    rows, columns, weights, steps = (a[order] for a in (rows, columns, weights, steps))
    # A sweep takes the entries last first: the last of a column is the one that comes first.
    last = np.full(variables.count, -1, dtype=np.int64)
    last[columns] = np.arange(len(columns))
    if variables.indices is not None:
        # What an index brings to a column is added, at any step that the medium touches.
        last[variables.indices.columns.numpy()] = -1
        around = codes[:, Code.BEFORE : Code.AFTER + 1, None] == variables.indices.rows.numpy()
        first_step = min(
            first_step, int(np.flatnonzero(around.any((1, 2))).min(initial=len(codes)))
        )
    empty = np.flatnonzero(last < 0)
    is_first = np.zeros(len(columns), dtype=np.int64)
    is_first[last[last >= 0]] = 1
    end = len(columns) + len(empty)
    padding = np.zeros_like(empty)
    arrays = (
        np.append(np.searchsorted(steps, np.arange(codes.shape[0] + 1)), end),
        np.append(rows, padding),
        np.append(columns, empty),
        np.append(weights, padding.astype(np.float64)),
        np.append(is_first, padding + 1),
    )
    return _Entries(first_step, spline, arrays, taken)
