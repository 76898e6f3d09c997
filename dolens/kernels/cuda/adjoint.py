"""The backward pass traces each block again, keeps its states, and sweeps cotangents back.

A fixed number of programs share all blocks.  Each has its own memory for the states of one block
and its own row of sums, so that neither grows with the number of rays.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.layout import (
    AFTER,
    BEFORE,
    OFFSET,
    ROW,
    STATE,
    TRAVELLED,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cuda.rays import (
    first_sense,
    load_columns,
    load_media,
    load_vectors,
    store_vectors,
)
from dolens.kernels.cuda.step import step
from dolens.kernels.cuda.step_adjoint import step_adjoint
from dolens.kernels.cuda.sums import add_by_column, add_sum

# One compiled kernel serves bundles of any size, strides and alignment.
_VARYING = (
    "exit_place", "wavelengths", "steps", "count", "blocks", "sum_length",
    "position_row", "position_column", "direction_row", "direction_column",
    "of_position_row", "of_position_column", "of_direction_row", "of_direction_column",
    "of_path_row",
)  # fmt: skip
_ANYWHERE = (
    "position", "direction", "which", "status", "of_position", "of_direction", "of_path",
)  # fmt: skip


@triton.jit
def _keep(state, BLOCK: tl.constexpr, x, y, z, l, m, n, travelled):
    lane = state + tl.arange(0, BLOCK)
    tl.store(lane + X * BLOCK, x)
    tl.store(lane + Y * BLOCK, y)
    tl.store(lane + Z * BLOCK, z)
    tl.store(lane + L * BLOCK, l)
    tl.store(lane + M * BLOCK, m)
    tl.store(lane + N * BLOCK, n)
    tl.store(lane + TRAVELLED * BLOCK, travelled)


@triton.jit
def _kept(state, BLOCK: tl.constexpr):
    lane = state + tl.arange(0, BLOCK)
    return (
        tl.load(lane + X * BLOCK),
        tl.load(lane + Y * BLOCK),
        tl.load(lane + Z * BLOCK),
        tl.load(lane + L * BLOCK),
        tl.load(lane + M * BLOCK),
        tl.load(lane + N * BLOCK),
        tl.load(lane + TRAVELLED * BLOCK),
    )


@triton.jit
def _vectors_or_zero(pointer, row, column, rays, mask, like):
    if pointer is None:
        zero = tl.zeros_like(like)
        return zero, zero, zero
    else:
        return load_vectors(pointer, row, column, rays, mask, 0.0)


@triton.jit(do_not_specialize=_VARYING, do_not_specialize_on_alignment=_ANYWHERE)
def adjoint_kernel(
    values, exit_place, media, wavelengths, codes, extras, steps, count, blocks,
    position, position_row, position_column, direction, direction_row, direction_column, which,
    status, of_position, of_position_row, of_position_column,
    of_direction, of_direction_row, of_direction_column, of_path, of_path_row,
    position_gradient, direction_gradient, sums, sum_length, scratch,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr, INDICES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Sweep cotangents back; see `dolens.kernels.cuda.backend.trace_adjoint`.

    Args:
        values: to `which`: as in `forward_kernel`; `blocks` is the number of blocks of rays.
        status: (count,), int8: only valid rays take part.
        of_position: cotangents of position, direction and path with their strides, or None.
        position_gradient: (count, 3), zero at first, or None; and of the direction.
        sums: (programs, sum_length), float64, zero at first: cotangents of `values`, then of the
            indices (media, wavelengths).
        scratch: (programs, steps + 1, STATE, BLOCK).
        KINDS: see `step`, and FORMS and LAWS.
        INDICES: whether cotangents of the indices are summed.
        BLOCK: rays a block.
    """
    program = tl.program_id(0).to(tl.int64)
    own_sums = sums + program * sum_length
    of_indices = own_sums + exit_place + 1
    states = scratch + program * (steps + 1) * STATE * BLOCK
    sense = first_sense(values, steps)
    for block in range(tl.program_id(0), blocks, tl.num_programs(0)):
        rays = (tl.zeros([BLOCK], tl.int64) + block) * BLOCK + tl.arange(0, BLOCK)
        alive = tl.load(status + rays, mask=rays < count, other=1) == 0
        if tl.max(alive.to(tl.int32), 0) > 0:
            # Rays that failed give way to axial ones: they would keep Newton's iteration busy.
            x, y, z = load_vectors(position, position_row, position_column, rays, alive, 0.0)
            l, m, n = load_vectors(direction, direction_row, direction_column, rays, alive, sense)
            columns = load_columns(which, rays, alive)
            path = tl.zeros_like(x)
            ended, vignetted = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
            _keep(states, BLOCK, x, y, z, l, m, n, path)
            for k in range(steps):
                row = codes + k * ROW
                record = values + tl.load(row + OFFSET)
                index, ratio, per_radian = load_media(media, k, wavelengths, columns)
                x, y, z, l, m, n, path, ended, vignetted, travelled = step(
                    row, record, extras, index, ratio, per_radian,
                    x, y, z, l, m, n, path, ended, vignetted, KINDS, FORMS, LAWS,
                )  # fmt: skip
                _keep(states + (k + 1) * STATE * BLOCK, BLOCK, x, y, z, l, m, n, travelled)
            # What one thread kept, another may read.
            tl.debug_barrier()
            px, py, pz = _vectors_or_zero(
                of_position, of_position_row, of_position_column, rays, alive, x
            )
            a, b, c = _vectors_or_zero(
                of_direction, of_direction_row, of_direction_column, rays, alive, x
            )
            if of_path is None:
                of_length = tl.zeros_like(x)
            else:
                of_length = tl.load(of_path + rays * of_path_row, mask=alive, other=0.0)
            add_sum(own_sums + exit_place, pz, alive)
            for back in range(steps):
                k = steps - 1 - back
                row = codes + k * ROW
                offset = tl.load(row + OFFSET)
                index, ratio, per_radian = load_media(media, k, wavelengths, columns)
                before = _kept(states + k * STATE * BLOCK, BLOCK)
                after = _kept(states + (k + 1) * STATE * BLOCK, BLOCK)
                px, py, pz, a, b, c, of_front, of_behind = step_adjoint(
                    row, values + offset, extras, own_sums + offset, index, ratio, per_radian,
                    before, after, px, py, pz, a, b, c, of_length, alive, KINDS, FORMS, LAWS,
                )  # fmt: skip
                if INDICES:
                    front = of_indices + tl.load(row + BEFORE) * wavelengths
                    behind = of_indices + tl.load(row + AFTER) * wavelengths
                    if which is None:
                        add_sum(front, of_front, alive)
                        add_sum(behind, of_behind, alive)
                    else:
                        add_by_column(front, behind, columns, of_front, of_behind, alive)
            if position_gradient is not None:
                store_vectors(position_gradient, rays, alive, px, py, pz)
            if direction_gradient is not None:
                store_vectors(direction_gradient, rays, alive, a, b, c)
            tl.debug_barrier()
