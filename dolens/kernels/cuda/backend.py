"""These functions run the Triton kernels on tensors of one lens."""

from torch import Tensor

from dolens.kernels.cuda import lenses
from dolens.kernels.table import SurfaceTable


def trace(
    table: SurfaceTable, position: Tensor, direction: Tensor, which: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry rays through every step.

    Args:
        table: the lens; its values and indices on the rays' device.
        position: (N, 3), mm, in the table's precision.
        direction: (N, 3), unit vectors.
        which: (N,), int32, each ray's column of `table.indices`, or None for the first.

    Returns:
        position (N, 3), direction (N, 3), path length (N,), mm; status (N,), int8; and the surface
        where the ray failed (N,), int16.

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    found = lenses.trace(table.alone(), (position[None], direction[None], which))
    position, direction, path, status, surface = (part[0] for part in found)
    return position, direction, path, status, surface


def trace_adjoint(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    status: Tensor,
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor, Tensor]:
    """Return the cotangents of rays and table from those of position, direction and path length.

    A repeated call on the same GPU gives the same bits.

    Args:
        table: as in `trace`, and the rays.
        position: (N, 3).
        direction: (N, 3).
        which: (N,), int32, or None.
        status: (N,), int8, from `trace`: only rays that are valid pass a gradient.
        cotangents: of position (N, 3), direction (N, 3) and path (N,), of any strides, or None.
        wanted: whether gradients of position, direction and indices are needed.

    Returns:
        Gradients of position and direction (None where not wanted), of `values` and of `indices`
        (zeros where not wanted).

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    of_position, of_direction, of_path = (None if c is None else c[None] for c in cotangents)
    found = lenses.trace_adjoint(
        table.alone(),
        (position[None], direction[None], which),
        status[None],
        (of_position, of_direction, of_path),
        wanted,
    )
    of_rays, of_directions, of_values, of_indices = found
    return (
        None if of_rays is None else of_rays[0],
        None if of_directions is None else of_directions[0],
        of_values[0],
        of_indices[0],
    )
