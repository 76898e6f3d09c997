"""A ray's derivatives come from one sweep back for each output, whatever the number of variables.

A ray depends on no other, so that the cotangents of a step's numbers are its own derivatives: they
are kept ray by ray, and go to the columns of the variables before the next step needs their place.
Tangents carried forward would pass every step once for each variable, by functions of their own for
every kind of surface; sweeps back pass it once for each output, by those that the gradient has.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import finite
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
)
from dolens.kernels.cuda.step import step
from dolens.kernels.cuda.step_adjoint import step_adjoint
from dolens.kernels.cuda.trace import (
    first_sense,
    keep,
    kept,
    load_columns,
    load_media,
    load_vectors,
    stop_unphysical,
)

# One compiled kernel serves bundles of any size, strides and alignment, and any variables.
_VARYING = (
    "values_lens", "media_lens", "wavelengths", "steps", "count", "blocks", "items",
    "position_lens", "position_row", "position_column",
    "direction_lens", "direction_row", "direction_column",
    "first_step", "weights_lens", "index_entries", "index_lens", "outputs", "variables", "longest",
)  # fmt: skip
_ANYWHERE = ("position", "direction", "which", "weights", "index_weights")


@triton.jit
def _unit(row, place: tl.constexpr, like):
    """Return ones where the output lies at this place of a state, else zeros."""
    return tl.where(row == place, 1.0, 0.0).to(like.dtype) + tl.zeros_like(like)


@triton.jit
def _add_column(place, alive, derivatives):
    tl.store(place, tl.load(place, mask=alive, other=0.0) + derivatives, mask=alive)


@triton.jit(do_not_specialize=_VARYING, do_not_specialize_on_alignment=_ANYWHERE)
def jacobian_kernel(
    values, values_lens, media, media_lens, wavelengths, codes, extras,
    steps, count, blocks, items, position, position_lens, position_row, position_column,
    direction, direction_lens, direction_row, direction_column, which,
    first_step, entries, entry_places, entry_columns, weights, weights_lens,
    index_entries, index_rows, index_columns, index_weights, index_lens,
    outputs, output_rows, variables, out_valid, out_values, out_jacobian,
    scratch, rows, longest,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Differentiate `count` rays of each lens; see `dolens.kernels.cuda.lenses.ray_jacobians`.

    Args:
        values: to `which`: as in `forward_kernel`.
        items: lenses times blocks.
        first_step: a sweep ends here, at the first step that any variable belongs to.
        entries: (steps + 1,), int32, where the entries of each step begin.
        entry_places: (E,), int32, place in the step's record.
        entry_columns: (E,), int32, the variable.
        weights: (E,), the derivative of the number with respect to the variable, of the first lens.
        weights_lens: as `values_lens`.
        index_entries: I, of the media.
        index_rows: (I,), int32, which of the media.
        index_columns: (I,), int32, the variable.
        index_weights: (I, wavelengths), the derivatives, of the first lens.
        index_lens: as `values_lens`.
        outputs: K.
        output_rows: (K,), int32, their rows of a state; that of the distance is the path length.
        variables: P.
        out_valid: (lenses, count), int8.
        out_values: (lenses, K, count).
        out_jacobian: (lenses, K, P, count), zero at first.
        scratch: (programs, steps + 1, STATE, BLOCK).
        rows: (programs, BLOCK, longest): each ray's cotangents of a step's numbers.
        longest: numbers of the longest record.
        KINDS: see `step`, and FORMS and LAWS.
        BLOCK: rays a block.
    """
    program = tl.program_id(0).to(tl.int64)
    states = scratch + program * (steps + 1) * STATE * BLOCK
    last = states + steps * STATE * BLOCK + tl.arange(0, BLOCK)
    own_rows = rows + (program * BLOCK + tl.arange(0, BLOCK)) * longest
    for item in range(tl.program_id(0), items, tl.num_programs(0)):
        lens = (item // blocks).to(tl.int64)
        rays = (tl.zeros([BLOCK], tl.int64) + item % blocks) * BLOCK + tl.arange(0, BLOCK)
        mask = rays < count
        own_values = values + lens * values_lens
        own_media = media + lens * media_lens
        sense = first_sense(own_values, steps)
        x, y, z = load_vectors(
            position + lens * position_lens, position_row, position_column, rays, mask, 0.0
        )
        l, m, n = load_vectors(
            direction + lens * direction_lens, direction_row, direction_column, rays, mask, sense
        )
        x, y, z, l, m, n = stop_unphysical(x, y, z, l, m, n)
        columns = load_columns(which, rays, mask)
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
        alive = mask & (ended == 0) & (vignetted == 0)
        tl.store(out_valid + lens * count + rays, alive.to(tl.int8), mask=mask)
        # What one thread kept, another may read.
        tl.debug_barrier()
        for output in range(outputs):
            wanted = tl.load(output_rows + output)
            value = tl.where(wanted == TRAVELLED, path, tl.load(last + wanted * BLOCK))
            place = out_values + (lens * outputs + output) * count + rays
            tl.store(place, tl.where(alive, finite(value), 0.0), mask=mask)
            own_columns = out_jacobian + (lens * outputs + output) * variables * count + rays
            px, py, pz = _unit(wanted, X, x), _unit(wanted, Y, x), tl.zeros_like(x)
            a, b, c = _unit(wanted, L, x), _unit(wanted, M, x), _unit(wanted, N, x)
            of_length = _unit(wanted, TRAVELLED, x)
            for back in range(steps - first_step):
                k = steps - 1 - back
                row = codes + k * ROW
                begin, end = tl.load(entries + k), tl.load(entries + k + 1)
                for e in range(begin, end):
                    tl.store(own_rows + tl.load(entry_places + e), tl.zeros_like(x))
                index, ratio, per_radian = load_media(own_media, k, wavelengths, columns)
                before = kept(states + k * STATE * BLOCK, BLOCK)
                after = kept(states + (k + 1) * STATE * BLOCK, BLOCK)
                px, py, pz, a, b, c, of_front, of_behind = step_adjoint(
                    row, own_values + tl.load(row + OFFSET), extras, own_rows,
                    index, ratio, per_radian, before, after,
                    px, py, pz, a, b, c, of_length, alive, KINDS, FORMS, LAWS,
                )  # fmt: skip
                tl.debug_barrier()
                for e in range(begin, end):
                    weight = tl.load(weights + lens * weights_lens + e)
                    derivative = tl.load(own_rows + tl.load(entry_places + e))
                    column = own_columns + tl.load(entry_columns + e).to(tl.int64) * count
                    _add_column(column, alive, weight * derivative)
                for e in range(index_entries):
                    medium = tl.load(index_rows + e)
                    of_index = tl.zeros_like(x)
                    if medium == tl.load(row + BEFORE):
                        of_index += of_front
                    if medium == tl.load(row + AFTER):
                        of_index += of_behind
                    weight = tl.load(index_weights + lens * index_lens + e * wavelengths + columns)
                    column = own_columns + tl.load(index_columns + e).to(tl.int64) * count
                    _add_column(column, alive, weight * of_index)
                tl.debug_barrier()
        tl.debug_barrier()
