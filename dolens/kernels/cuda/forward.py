"""In the forward trace each program carries a block of rays through all steps, in registers."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import finite
from dolens.kernels.cuda.layout import OFFSET, ROW, STATUS_BITS, STATUS_MASK
from dolens.kernels.cuda.rays import (
    first_sense,
    load_columns,
    load_media,
    load_vectors,
    stop_unphysical,
    store_vectors,
)
from dolens.kernels.cuda.step import step

# One compiled kernel serves bundles of any size, strides and alignment.
_VARYING = (
    "values_lens", "exit_place", "media_lens", "wavelengths", "steps", "count", "blocks",
    "position_lens", "position_row", "position_column",
    "direction_lens", "direction_row", "direction_column",
)  # fmt: skip


@triton.jit(
    do_not_specialize=_VARYING, do_not_specialize_on_alignment=("position", "direction", "which")
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
