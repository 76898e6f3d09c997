"""These functions run the CPU kernels on many lenses of one structure at once.

Tables, rays and what is found have a leading dimension of L lenses.  Whatever all lenses share may
be expanded to it (a stride of zero): it is read where it is.

The driver of many lenses runs another driver for one lens after the other.

Lenses of one structure share the codes of their steps, so that they differ in addresses only: those
of their numbers, of their indices, of their rays and of what is written.  Each moves on by a fixed
number of bytes from one lens to the next.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numba import carray, types
from torch import Tensor

from dolens.kernels.cpu import compiler, jobs
from dolens.kernels.cpu.adjoint import adjoint_driver
from dolens.kernels.cpu.backend import chunk_size
from dolens.kernels.cpu.compiler import call_driver, int64_at
from dolens.kernels.cpu.forward import forward_driver
from dolens.kernels.cpu.jacobian import jacobian_driver
from dolens.kernels.cpu.layout import BLOCK, UNBOUNDED
from dolens.kernels.cpu.least_squares import normal_equations_driver
from dolens.kernels.cpu.program import Derivatives, Program, rays_of_a_chunk
from dolens.kernels.table import MapOfLenses, SurfaceTable

# Fewer rays than these, of all lenses, are done sooner than another thread is woken.
_SMALL_TRACE, _SMALL_DERIVATIVES = 1 << 13, 1 << 10

# Places of addresses that the strides of their tensors follow.
_COTANGENTS = (jobs.POSITION_COTANGENT, jobs.DIRECTION_COTANGENT, jobs.PATH_COTANGENT)

RayTensors = tuple[Tensor, Tensor, Tensor | None]


def trace(table: SurfaceTable, rays: RayTensors) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry the rays of every lens through its steps.

    Args:
        table: `values` (L, V) and `indices` (L, media, wavelengths).
        rays: position (L, N, 3), mm, and direction (L, N, 3), in the table's precision; and the
            wavelength's column of each ray (N,), int32, the same for all lenses, or None.

    Returns:
        position (L, N, 3), direction (L, N, 3), path length (L, N), mm; status (L, N), int8; and
        the surface where the ray failed (L, N), int16.
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    out = (
        position.new_empty((lenses, count, 3)),
        position.new_empty((lenses, count, 3)),
        position.new_empty((lenses, count)),
        torch.empty((lenses, count), dtype=torch.int8),
        torch.empty((lenses, count), dtype=torch.int16),
    )
    if lenses == 0 or count == 0:
        return out
    program = Program(_first(table), derivatives=False)
    program.set_rays(position[0], direction[0], which)
    names = ("OUT_POSITION", "OUT_DIRECTION", "OUT_PATH", "OUT_STATUS", "OUT_SURFACE")
    by_lens = _lenses_of(table, position, direction)
    for name, tensor in zip(names, out, strict=True):
        program.point(**{name: tensor})
        by_lens[getattr(jobs, name)] = tensor
    run_lenses(program, forward_driver, lenses, -(-count // BLOCK), by_lens, _SMALL_TRACE)
    return out


def trace_adjoint(
    table: SurfaceTable,
    rays: RayTensors,
    status: Tensor,
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor, Tensor]:
    """Return the cotangents of rays and tables from those of position, direction and path length.

    Args:
        table: as in `trace`, and the rays.
        rays: L × N of them.
        status: (L, N), int8, contiguous, from `trace`.
        cotangents: of position (L, N, 3), direction (L, N, 3) and path (L, N), of any strides, or
            None.
        wanted: whether gradients of position, direction and indices are needed.

    Returns:
        Gradients of position and direction (None where not wanted), of `values` and of `indices`
        (zeros where not wanted).
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    gradients = [position.new_zeros((lenses, count, 3)) if want else None for want in wanted[:2]]
    cut = table.values.shape[1]
    length = cut + table.indices[0].numel()
    chunk = chunk_size(count)
    chunks = -(-count // chunk)
    sums = torch.zeros((lenses, chunks, length), dtype=torch.float64)
    if lenses and count:
        program = Program(_first(table), derivatives=True)
        program.set_rays(position[0], direction[0], which)
        job = program.job
        job[jobs.SUM_LENGTH], job[jobs.CHUNK] = length, chunk
        job[jobs.INDEX_SUMS] = int(wanted[2])
        by_lens = _lenses_of(table, position, direction)
        for place, tensor in (
            (jobs.OUT_STATUS, status),
            (jobs.SUMS, sums),
            (jobs.POSITION_GRADIENT, gradients[0]),
            (jobs.DIRECTION_GRADIENT, gradients[1]),
            (jobs.POSITION_COTANGENT, cotangents[0]),
            (jobs.DIRECTION_COTANGENT, cotangents[1]),
            (jobs.PATH_COTANGENT, cotangents[2]),
        ):
            if tensor is not None:
                job[place] = tensor.data_ptr()
                by_lens[place] = tensor
            if tensor is not None and place in _COTANGENTS:
                job[place + 1 : place + tensor.dim()] = tensor.stride()[1:]
        run_lenses(program, adjoint_driver, lenses, chunks, by_lens, _SMALL_DERIVATIVES)
    total = sums.sum(1)
    return (
        gradients[0],
        gradients[1],
        total[:, :cut].to(table.values.dtype, copy=True),
        total[:, cut:].reshape(table.indices.shape).clone(),
    )


def ray_jacobians(
    table: SurfaceTable,
    variables: MapOfLenses,
    outputs: Sequence[str],
    rays: RayTensors,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the outputs of every ray of every lens and their derivatives.

    Args:
        table: as in `trace`.
        variables: P of them.
        outputs: K names of `dolens.kernels.table.OUTPUT_ROWS`.
        rays: as in `trace`.

    Returns:
        valid (L, N), bool; outputs (L, K, N); derivatives (L, K, P, N); zero where a ray is not
        valid.
    """
    position = rays[0]
    lenses, count = position.shape[:2]
    wanted = len(outputs)
    valid = torch.empty((lenses, count), dtype=torch.bool)
    values = position.new_empty((lenses, wanted, count))
    jacobian = position.new_empty((lenses, wanted, variables.count, count))
    if lenses and count:
        chunk = rays_of_a_chunk(count, 1)
        found = _derivatives(table, variables, outputs, rays, chunk, 0)
        by_lens = _lenses_of(table, *rays[:2])
        by_lens |= _weights_of(found, variables)
        for place, tensor in (
            (jobs.OUT_VALID, valid),
            (jobs.OUT_VALUES, values),
            (jobs.OUT_JACOBIAN, jacobian),
        ):
            found.program.job[place] = tensor.data_ptr()
            by_lens[place] = tensor
        pieces = -(-count // chunk)
        run_lenses(found.program, jacobian_driver, lenses, pieces, by_lens, _SMALL_DERIVATIVES)
    return valid, values, jacobian


def normal_equations(
    table: SurfaceTable,
    variables: MapOfLenses,
    outputs: Sequence[str],
    rays: RayTensors,
    target: Tensor,
    weight: Tensor | None = None,
    group: Tensor | None = None,
    groups: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return sums over the valid rays of every lens for least squares with r = output - target.

    Args:
        table: as in `ray_jacobians`, and the three that follow.
        variables: P of them.
        outputs: K names.
        rays: L × N of them.
        target: (L, N, K), of any strides, in the rays' precision.
        weight: (L, N), of any strides, in the rays' precision; None: one.
        group: (N,), int64, contiguous, from 0 to `groups` - 1, the same for all lenses; None: no
            sums by group.
        groups: G.

    Returns:
        All float64: number of rays and Σ w·r² (L, 2); Jᵀwr (L, P); JᵀwJ (L, P, P); and by groups
        (L, G, 2 + K + K·P): number of rays, Σ w, Σ w·r, Σ w·J.  Lenses whose products overflow in
        single precision are computed once more in double.
    """
    position = rays[0]
    (lenses, count), wanted, p = position.shape[:2], len(outputs), variables.count
    by_group = 2 + wanted * (1 + p)
    length = 2 + p + p * p + groups * by_group
    chunk = rays_of_a_chunk(count, length)
    chunks = -(-count // chunk)
    sums = torch.zeros((lenses, chunks, length), dtype=torch.float64)
    if lenses and count:
        further = p + 1 + wanted
        found = _derivatives(table, variables, outputs, rays, chunk, further)
        job = found.program.job
        found.program.point(TARGET=target, WEIGHT=weight, GROUP=group, SUMS=sums)
        job[jobs.SUM_LENGTH], job[jobs.GROUPS] = length, groups
        job[jobs.TARGET_ROW], job[jobs.TARGET_COLUMN] = target.stride()[1:]
        by_lens = _lenses_of(table, *rays[:2]) | {jobs.SUMS: sums, jobs.TARGET: target}
        by_lens |= _weights_of(found, variables)
        if weight is not None:
            job[jobs.WEIGHT_ROW] = weight.stride(1)
            by_lens[jobs.WEIGHT] = weight
        run_lenses(
            found.program, normal_equations_driver, lenses, chunks, by_lens, _SMALL_DERIVATIVES
        )
    total = sums[:, 0] if chunks == 1 else sums.sum(1)
    head, right, square, rest = total.split([2, p, p * p, groups * by_group], -1)
    lower = square.reshape(lenses, p, p)
    square = lower + lower.tril(-1).mT
    rest = rest.reshape(lenses, groups, by_group)
    if table.values.dtype == torch.float32:
        overflown = torch.nonzero(~torch.isfinite(total).all(-1))[:, 0]
        if len(overflown):
            again = normal_equations(
                replace(
                    table,
                    values=table.values[overflown].double(),
                    indices=table.indices[overflown],
                ),
                variables.of(overflown),
                outputs,
                (position[overflown].double(), rays[1][overflown].double(), rays[2]),
                target[overflown].double(),
                None if weight is None else weight[overflown].double(),
                group,
                groups,
            )
            first = (head.clone(), right.clone(), square, rest.clone())
            for part, better in zip(first, again, strict=True):
                part[overflown] = better
            return first
    return head, right, square, rest


def _first(table: SurfaceTable) -> SurfaceTable:
    """Return the table of the first lens, whose tensors begin where those of all do."""
    return replace(table, values=table.values[0], indices=table.indices[0])


def _lenses_of(table: SurfaceTable, position: Tensor, direction: Tensor) -> dict[int, Tensor]:
    """Return what differs from lens to lens in front of every driver, by its place."""
    return {
        jobs.VALUES: table.values,
        jobs.EXIT_Z: table.values,
        jobs.INDICES: table.indices,
        jobs.POSITION: position,
        jobs.DIRECTION: direction,
    }


def _derivatives(
    table: SurfaceTable,
    variables: MapOfLenses,
    outputs: Sequence[str],
    rays: RayTensors,
    chunk: int,
    further: int,
) -> Derivatives:
    """Return the program of derivatives of the first lens."""
    of_first = (rays[0][0], rays[1][0], rays[2])
    slopes = variables.index_derivatives
    first = None if slopes is None else slopes[0]
    return Derivatives(_first(table), variables.map, outputs, of_first, chunk, further, first)


def _weights_of(found: Derivatives, variables: MapOfLenses) -> dict[int, Tensor]:
    """Point to the weights of every lens; return them by their places."""
    by_lens: dict[int, Tensor] = {}
    if variables.weights is not None:
        by_lens[jobs.ENTRY_WEIGHTS] = found.hold(variables.weights)
    if variables.index_derivatives is not None:
        by_lens[jobs.INDEX_WEIGHTS] = variables.index_derivatives
    return by_lens


def lenses_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that runs the inner driver over all its pieces for lenses `first` to
    `last`.
    """

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        pairs = carray(int64_at(job[jobs.STRIDES]), UNBOUNDED)
        for lens in range(first, last):
            for i in range(job[jobs.STRIDE_PAIRS]):
                job[pairs[2 * i]] += lens * pairs[2 * i + 1]
            call_driver(job[jobs.INNER_DRIVER], job_, 0, job[jobs.INNER_PIECES])
            for i in range(job[jobs.STRIDE_PAIRS]):
                job[pairs[2 * i]] -= lens * pairs[2 * i + 1]

    return kernel


def run_lenses(
    program: Program,
    driver: Callable[[types.Type], Callable[..., None]],
    lenses: int,
    pieces: int,
    by_lens: Mapping[int, Tensor],
    small: int,
) -> None:
    """Run a driver for every lens; threads share lenses, or the pieces of a single one.

    Args:
        program: of the first lens, pointed to everything that the driver needs.
        driver: the factory of the driver of one lens.
        lenses: L.
        pieces: of one lens.
        by_lens: place in the job → tensor (L, ...) whose first lens that place points to; a stride
            of zero shares it.
        small: fewer rays than this, of all lenses, are traced by one thread.
    """
    if lenses == 1:
        program.run(driver, pieces, small)
        return
    pairs = [(place, t.stride(0) * t.element_size()) for place, t in by_lens.items()]
    strides = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    job = program.job
    job[jobs.INNER_DRIVER] = compiler.compile_driver(driver, program.real)
    job[jobs.INNER_PIECES], job[jobs.STRIDE_PAIRS] = pieces, len(strides)
    job[jobs.STRIDES] = strides.ctypes.data
    program.run(lenses_driver, lenses, small, lenses)
