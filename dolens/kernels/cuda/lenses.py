"""These functions run the Triton kernels on many lenses of one structure at once.

Tables, rays and what is found have a leading dimension of L lenses.  Whatever all lenses share may
be expanded to it (a stride of zero): it is read where it is.
"""

from collections.abc import Sequence

import torch
import triton
from torch import Tensor

from dolens.kernels.cuda import device_table
from dolens.kernels.cuda.device_table import device_entries, on, prepared, program_count, strides
from dolens.kernels.cuda.jacobian import jacobian_kernel
from dolens.kernels.cuda.layout import STATE
from dolens.kernels.cuda.trace import adjoint_kernel, forward_kernel
from dolens.kernels.least_squares_sums import least_squares_sums
from dolens.kernels.table import MapOfLenses, SurfaceTable

RayTensors = tuple[Tensor, Tensor, Tensor | None]
# Numbers of a Jacobian, or of groups, that are held at a time while normal equations are added up.
_NUMBERS = 1 << 24


def trace(table: SurfaceTable, rays: RayTensors) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry the rays of every lens through its steps.

    Args:
        table: `values` (L, V) and `indices` (L, media, wavelengths), on the rays' device.
        rays: position (L, N, 3), mm, and direction (L, N, 3), in the table's precision; and the
            wavelength's column of each ray (N,), int32, the same for all lenses, or None.

    Returns:
        position (L, N, 3), direction (L, N, 3), path length (L, N), mm; status (L, N), int8; and
        the surface where the ray failed (L, N), int16.

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    out = (
        position.new_empty((lenses, count, 3)),
        position.new_empty((lenses, count, 3)),
        position.new_empty((lenses, count)),
        position.new_empty((lenses, count), dtype=torch.int8),
        position.new_empty((lenses, count), dtype=torch.int16),
    )
    if lenses == 0 or count == 0:
        return out
    codes, media = prepared(table, position)
    values, block = table.values, device_table.FORWARD_BLOCK
    blocks = triton.cdiv(count, block)
    with on(position.device):
        forward_kernel[(lenses * blocks,)](
            values, values.stride(0), values.shape[1] - 1, media, media.stride(0), media.shape[3],
            codes.codes, codes.extras, len(codes.codes), count, blocks,
            position, *position.stride(), direction, *direction.stride(), which,
            *out, KINDS=codes.kinds, FORMS=codes.forms, LAWS=codes.laws,
            BLOCK=block, **device_table.OPTIONS,
        )  # fmt: skip
    return out


def trace_adjoint(
    table: SurfaceTable,
    rays: RayTensors,
    status: Tensor,
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor, Tensor]:
    """Return the cotangents of rays and tables from those of position, direction and path length.

    A repeated call on the same GPU gives the same bits.

    Args:
        table: as in `trace`, and the rays.
        rays: L × N of them.
        status: (L, N), int8, contiguous, from `trace`: only valid rays pass a gradient.
        cotangents: of position (L, N, 3), direction (L, N, 3) and path (L, N), of any strides, or
            None.
        wanted: whether gradients of position, direction and indices are needed.

    Returns:
        Gradients of position and direction (None where not wanted), of `values` and of `indices`
        (zeros where not wanted).

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    values, cut = table.values, table.values.shape[1]
    gradients = [position.new_zeros((lenses, count, 3)) if want else None for want in wanted[:2]]
    length = cut + table.indices[0].numel()
    block = device_table.ADJOINT_BLOCK[values.dtype]
    blocks = triton.cdiv(count, block)
    codes, media = prepared(table, position)
    steps = len(codes.codes)
    kept = (steps + 1) * STATE.value * block
    bytes_kept = kept * values.element_size() + length * 8
    programs = program_count(lenses * count, lenses * blocks, bytes_kept, position.device)
    # Programs that share a lens have a row of sums each.
    parts = max(1, programs // max(1, lenses))
    items = lenses * parts
    sums = torch.zeros((items, length), dtype=torch.float64, device=position.device)
    if lenses and count:
        of_position, of_direction, of_path = cotangents
        programs = min(programs, items)
        with on(position.device):
            adjoint_kernel[(programs,)](
                values, values.stride(0), cut - 1, media, media.stride(0), media.shape[3],
                codes.codes, codes.extras, steps, count, blocks, parts, items,
                position, *position.stride(), direction, *direction.stride(), which, status,
                of_position, *strides(of_position, 3), of_direction, *strides(of_direction, 3),
                of_path, *strides(of_path, 2), *gradients, sums, length,
                values.new_empty(programs * kept),
                KINDS=codes.kinds, FORMS=codes.forms, LAWS=codes.laws, INDICES=wanted[2],
                BLOCK=block, **device_table.OPTIONS,
            )  # fmt: skip
    total = sums.reshape(lenses, parts, length).sum(1)
    return (
        gradients[0],
        gradients[1],
        total[:, :cut].to(values.dtype, copy=True),
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

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    values, wanted = table.values, len(outputs)
    valid = position.new_empty((lenses, count), dtype=torch.int8)
    found = position.new_empty((lenses, wanted, count))
    jacobian = position.new_zeros((lenses, wanted, variables.count, count))
    if lenses == 0 or count == 0:
        return valid.bool(), found, jacobian
    codes, media = prepared(table, position)
    entries = device_entries(table, variables.map, outputs, position.device)
    weights, slopes = variables.weights, variables.index_derivatives
    own = (entries.weights if weights is None else weights[:, entries.order]).to(values)
    of_index = None
    if variables.map.indices is not None:
        assert slopes is not None  # they go with the map
        of_index = slopes.to(values).contiguous()
    block, steps = device_table.JACOBIAN_BLOCK, len(codes.codes)
    blocks = triton.cdiv(count, block)
    kept = (steps + 1) * STATE.value * block
    bytes_kept = (kept + block * entries.longest) * values.element_size()
    programs = program_count(lenses * count, lenses * blocks, bytes_kept, position.device)
    with on(position.device):
        jacobian_kernel[(programs,)](
            values, values.stride(0), media, media.stride(0), media.shape[3],
            codes.codes, codes.extras, steps, count, blocks, lenses * blocks,
            position, *position.stride(), direction, *direction.stride(), which,
            entries.first_step, entries.begins, entries.places, entries.columns,
            own, own.stride(0) if own.dim() == 2 else 0,
            len(entries.index_rows), entries.index_rows, entries.index_columns,
            own if of_index is None else of_index, 0 if of_index is None else of_index.stride(0),
            wanted, entries.outputs, variables.count, valid, found, jacobian,
            values.new_empty(programs * kept), values.new_empty(programs * block * entries.longest),
            entries.longest, KINDS=codes.kinds, FORMS=codes.forms, LAWS=codes.laws,
            BLOCK=block, **device_table.OPTIONS,
        )  # fmt: skip
    return valid.bool(), found, jacobian


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

    The products are those of batches of matrices, which a GPU has units for; Jacobians are held of
    some lenses, or some rays, at a time.  A repeated call on the same GPU gives the same bits.

    Args:
        table: as in `ray_jacobians`, and the three that follow.
        variables: P of them.
        outputs: K names.
        rays: L × N of them.
        target: (L, N, K), mm.
        weight: (L, N); None: one.
        group: (N,), int64, from 0 to `groups` - 1, the same for all lenses; None: no sums by group.
        groups: G.

    Returns:
        All float64: number of rays and Σ w·r² (L, 2); Jᵀwr (L, P); JᵀwJ (L, P, P); and by groups
        (L, G, 2 + K + K·P): number of rays, Σ w, Σ w·r, Σ w·J.

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    position, direction, which = rays
    lenses, count = position.shape[:2]
    numbers = max(1, len(outputs) * variables.count, groups)
    few_rays = max(1, min(count, _NUMBERS // numbers))
    few_lenses = max(1, _NUMBERS // (numbers * few_rays))
    found = []
    for first in range(0, max(lenses, 1), few_lenses):
        some = slice(first, first + few_lenses)
        lens = SurfaceTable(table.values[some], table.indices[some], table.codes, table.extras)
        sums: tuple[Tensor, ...] = ()
        for start in range(0, max(count, 1), few_rays):
            part = slice(start, start + few_rays)
            valid, values, jacobian = ray_jacobians(
                lens,
                variables.of(some),
                outputs,
                (
                    position[some, part],
                    direction[some, part],
                    None if which is None else which[part],
                ),
            )
            added = least_squares_sums(
                valid,
                values,
                jacobian,
                target[some, part],
                None if weight is None else weight[some, part],
                None if group is None else group[part],
                groups,
            )
            sums = tuple(a + b for a, b in zip(sums, added, strict=True)) if sums else added
        found.append(sums)
    head, right, square, by_group = (torch.cat(part) for part in zip(*found, strict=True))
    return head, right, square, by_group
