"""The forward trace and its adjoint: each program carries a block of rays through all steps.

The backward pass traces each block again, keeps its states, and sweeps cotangents back.

A fixed number of programs share the blocks of all lenses.  Each has its own memory for the states
of one block, and each lens as many rows of sums as programs share it, so that neither grows with
the number of rays.
"""

import triton
import triton.language as tl

from dolens.kernels import table
from dolens.kernels.cuda.arithmetic import add_by_column, add_sum, finite
from dolens.kernels.cuda.layout import (
    AFTER,
    BEFORE,
    OFFSET,
    ROW,
    SENSE,
    STATE,
    STATUS_BITS,
    STATUS_MASK,
    TRAVELLED,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cuda.step import step
from dolens.kernels.cuda.step_adjoint import step_adjoint

_FARTHEST, _LONGEST = tl.constexpr(table.FARTHEST), tl.constexpr(table.LONGEST)


@triton.jit
def load_vectors(pointer, row, column, rays, mask, third):
    """Load x, y, z of each ray's vector; (0, 0, third) where the mask is off."""
    place = pointer + rays * row
    return (
        tl.load(place, mask=mask, other=0.0),
        tl.load(place + column, mask=mask, other=0.0),
        tl.load(place + 2 * column, mask=mask, other=third),
    )


@triton.jit
def stop_unphysical(x, y, z, l, m, n):
    """Let rays that are none of light stand still at 0, as `finite_rays` does."""
    known = (tl.abs(x) <= _FARTHEST) & (tl.abs(y) <= _FARTHEST) & (tl.abs(z) <= _FARTHEST)
    known &= (tl.abs(l) <= _LONGEST) & (tl.abs(m) <= _LONGEST) & (tl.abs(n) <= _LONGEST)
    return (
        tl.where(known, x, 0.0),
        tl.where(known, y, 0.0),
        tl.where(known, z, 0.0),
        tl.where(known, l, 0.0),
        tl.where(known, m, 0.0),
        tl.where(known, n, 0.0),
    )


@triton.jit
def store_vectors(pointer, rays, mask, x, y, z):
    """Write vectors to (N, 3), contiguous."""
    place = pointer + rays * 3
    tl.store(place, x, mask=mask)
    tl.store(place + 1, y, mask=mask)
    tl.store(place + 2, z, mask=mask)


@triton.jit
def first_sense(values, steps):
    """Return +1 or -1 from the first record: the sense of the axial rays that fill a block up."""
    return tl.load(values + SENSE, mask=steps > 0, other=1.0)


@triton.jit
def load_columns(which, rays, mask):
    """Load each ray's column of the indices; one for all where none is given."""
    if which is None:
        return 0
    else:
        return tl.load(which + rays, mask=mask, other=0)


@triton.jit
def load_media(media, k, wavelengths, columns):
    """Load the index in front of step k, its ratio μ to the one behind, and λ/2π (mm), which only
    the steps of a deflection have.
    """
    front = media + 3 * k * wavelengths + columns
    return tl.load(front), tl.load(front + wavelengths), tl.load(front + 2 * wavelengths)


# One compiled kernel serves bundles of any size, strides and alignment.
_VARYING_FORWARD = (
    "values_lens", "exit_place", "media_lens", "wavelengths", "steps", "count", "blocks",
    "position_lens", "position_row", "position_column",
    "direction_lens", "direction_row", "direction_column",
)  # fmt: skip


@triton.jit(
    do_not_specialize=_VARYING_FORWARD,
    do_not_specialize_on_alignment=("position", "direction", "which"),
)
def forward_kernel(
    values, values_lens, exit_place, media, media_lens, wavelengths, codes, extras,
    steps, count, blocks, position, position_lens, position_row, position_column,
    direction, direction_lens, direction_row, direction_column, which,
    out_position, out_direction, out_path, out_status, out_surface,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Trace `count` rays of each lens; see `dolens.kernels.cuda.lenses.trace`.

    Args:
        values: the records of the first lens.
        values_lens: numbers from a lens to the next one's; and so on.
        exit_place: where in `values` the number lies that is added to z in the end.
        media: (steps, 3, wavelengths): index in front, ratio μ, and λ/2π of a deflection.
        media_lens: as `values_lens`.
        wavelengths: columns of `media`.
        codes: (steps, ROW), int32.
        extras: int32.
        steps: rows of `codes`.
        count: rays of a lens.
        blocks: of rays of a lens; a program takes one.
        position: (count, 3), with its strides; and so on for the direction.
        which: (count,), int32, or None.
        out_position: and the other results, (lenses, count, ...), contiguous.
        KINDS: see `step`, and FORMS and LAWS.
        BLOCK: rays a program.
    """
    program = tl.program_id(0).to(tl.int64)
    lens = program // blocks
    rays = (program % blocks) * BLOCK + tl.arange(0, BLOCK)
    mask = rays < count
    values += lens * values_lens
    media += lens * media_lens
    position += lens * position_lens
    direction += lens * direction_lens
    x, y, z = load_vectors(position, position_row, position_column, rays, mask, 0.0)
    sense = first_sense(values, steps)
    l, m, n = load_vectors(direction, direction_row, direction_column, rays, mask, sense)
    x, y, z, l, m, n = stop_unphysical(x, y, z, l, m, n)
    columns = load_columns(which, rays, mask)
    path = tl.zeros_like(x)
    ended, vignetted = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
    for k in range(steps):
        row = codes + k * ROW
        record = values + tl.load(row + OFFSET)
        index, ratio, per_radian = load_media(media, k, wavelengths, columns)
        x, y, z, l, m, n, path, ended, vignetted, _ = step(
            row,
            record,
            extras,
            index,
            ratio,
            per_radian,
            x,
            y,
            z,
            l,
            m,
            n,
            path,
            ended,
            vignetted,
            KINDS,
            FORMS,
            LAWS,
        )
    z = z + tl.load(values + exit_place)
    rays += lens * count
    # Rays that are not valid may overflow.
    store_vectors(out_position, rays, mask, finite(x), finite(y), finite(z))
    store_vectors(out_direction, rays, mask, finite(l), finite(m), finite(n))
    tl.store(out_path + rays, finite(path), mask=mask)
    failed = tl.where(ended > 0, ended, vignetted)
    tl.store(out_status + rays, (failed & STATUS_MASK).to(tl.int8), mask=mask)
    tl.store(out_surface + rays, (failed >> STATUS_BITS).to(tl.int16), mask=mask)


# One compiled kernel serves bundles of any size, strides and alignment.
_VARYING = (
    "values_lens", "exit_place", "media_lens", "wavelengths", "steps", "count", "blocks",
    "parts", "items", "sum_length",
    "position_lens", "position_row", "position_column",
    "direction_lens", "direction_row", "direction_column",
    "of_position_lens", "of_position_row", "of_position_column",
    "of_direction_lens", "of_direction_row", "of_direction_column",
    "of_path_lens", "of_path_row",
)  # fmt: skip
_ANYWHERE = (
    "position", "direction", "which", "status", "of_position", "of_direction", "of_path",
)  # fmt: skip


@triton.jit
def keep(state, BLOCK: tl.constexpr, x, y, z, l, m, n, travelled):
    """Write the state of a block: the ray, and the distance to where it is."""
    lane = state + tl.arange(0, BLOCK)
    tl.store(lane + X * BLOCK, x)
    tl.store(lane + Y * BLOCK, y)
    tl.store(lane + Z * BLOCK, z)
    tl.store(lane + L * BLOCK, l)
    tl.store(lane + M * BLOCK, m)
    tl.store(lane + N * BLOCK, n)
    tl.store(lane + TRAVELLED * BLOCK, travelled)


@triton.jit
def kept(state, BLOCK: tl.constexpr):
    """Return the state of a block that `keep` wrote."""
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
def _vectors_or_zero(pointer, lens, row, column, rays, mask, like):
    if pointer is None:
        zero = tl.zeros_like(like)
        return zero, zero, zero
    else:
        return load_vectors(pointer + lens, row, column, rays, mask, 0.0)


@triton.jit(do_not_specialize=_VARYING, do_not_specialize_on_alignment=_ANYWHERE)
def adjoint_kernel(
    values, values_lens, exit_place, media, media_lens, wavelengths, codes, extras,
    steps, count, blocks, parts, items, position, position_lens, position_row, position_column,
    direction, direction_lens, direction_row, direction_column, which, status,
    of_position, of_position_lens, of_position_row, of_position_column,
    of_direction, of_direction_lens, of_direction_row, of_direction_column,
    of_path, of_path_lens, of_path_row,
    position_gradient, direction_gradient, sums, sum_length, scratch,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr, INDICES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Sweep cotangents back; see `dolens.kernels.cuda.lenses.trace_adjoint`.

    Args:
        values: to `which`: as in `forward_kernel`.
        parts: programs that share a lens: each takes every so many of its blocks.
        items: lenses times parts.
        status: (lenses, count), int8: only valid rays take part.
        of_position: cotangents of position, direction and path with their strides, or None.
        position_gradient: (lenses, count, 3), zero at first, or None; and of the direction.
        sums: (items, sum_length), float64, zero at first: cotangents of `values`, then of the
            indices (media, wavelengths).
        scratch: (programs, steps + 1, STATE, BLOCK).
        KINDS: see `step`, and FORMS and LAWS.
        INDICES: whether cotangents of the indices are summed.
        BLOCK: rays a block.
    """
    program = tl.program_id(0).to(tl.int64)
    states = scratch + program * (steps + 1) * STATE * BLOCK
    for item in range(tl.program_id(0), items, tl.num_programs(0)):
        lens = (item // parts).to(tl.int64)
        own_sums = sums + (lens * parts + item % parts) * sum_length
        of_indices = own_sums + exit_place + 1
        own_values = values + lens * values_lens
        own_media = media + lens * media_lens
        sense = first_sense(own_values, steps)
        for block in range(item % parts, blocks, parts):
            rays = (tl.zeros([BLOCK], tl.int64) + block) * BLOCK + tl.arange(0, BLOCK)
            place = rays + lens * count
            alive = tl.load(status + place, mask=rays < count, other=1) == 0
            if tl.max(alive.to(tl.int32), 0) > 0:
                # Rays that failed give way to axial ones: they would keep Newton's iteration busy.
                x, y, z = load_vectors(
                    position + lens * position_lens, position_row, position_column, rays, alive, 0.0
                )
                l, m, n = load_vectors(
                    direction + lens * direction_lens, direction_row, direction_column,
                    rays, alive, sense,
                )  # fmt: skip
                columns = load_columns(which, rays, alive)
                path = tl.zeros_like(x)
                ended, vignetted = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
                keep(states, BLOCK, x, y, z, l, m, n, path)
                for k in range(steps):
                    row = codes + k * ROW
                    record = own_values + tl.load(row + OFFSET)
                    index, ratio, per_radian = load_media(own_media, k, wavelengths, columns)
                    x, y, z, l, m, n, path, ended, vignetted, travelled = step(
                        row, record, extras, index, ratio, per_radian,
                        x, y, z, l, m, n, path, ended, vignetted, KINDS, FORMS, LAWS,
                    )  # fmt: skip
                    keep(states + (k + 1) * STATE * BLOCK, BLOCK, x, y, z, l, m, n, travelled)
                # What one thread kept, another may read.
                tl.debug_barrier()
                px, py, pz = _vectors_or_zero(
                    of_position, lens * of_position_lens, of_position_row, of_position_column,
                    rays, alive, x,
                )  # fmt: skip
                a, b, c = _vectors_or_zero(
                    of_direction, lens * of_direction_lens, of_direction_row, of_direction_column,
                    rays, alive, x,
                )  # fmt: skip
                if of_path is None:
                    of_length = tl.zeros_like(x)
                else:
                    lengths = of_path + lens * of_path_lens + rays * of_path_row
                    of_length = tl.load(lengths, mask=alive, other=0.0)
                add_sum(own_sums + exit_place, pz, alive)
                for back in range(steps):
                    k = steps - 1 - back
                    row = codes + k * ROW
                    offset = tl.load(row + OFFSET)
                    index, ratio, per_radian = load_media(own_media, k, wavelengths, columns)
                    before = kept(states + k * STATE * BLOCK, BLOCK)
                    after = kept(states + (k + 1) * STATE * BLOCK, BLOCK)
                    px, py, pz, a, b, c, of_front, of_behind = step_adjoint(
                        row, own_values + offset, extras, own_sums + offset,
                        index, ratio, per_radian, before, after,
                        px, py, pz, a, b, c, of_length, alive, KINDS, FORMS, LAWS,
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
                    store_vectors(position_gradient, place, alive, px, py, pz)
                if direction_gradient is not None:
                    store_vectors(direction_gradient, place, alive, a, b, c)
                tl.debug_barrier()
