"""Lenses of a family are traced some at a time, so that what is found of them stays in the cache.

Their records are packed once for all: where poses vary, that takes as long for one lens as for a
thousand.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dolens.kernels.operators import kernels_of_lenses
from dolens.optics.lens_family import FamilyJacobian, FamilyRays, LensFamily
from dolens.optics.rays import Status


@torch.no_grad()
def intercept_parts(
    family: LensFamily, values: Tensor, rays: FamilyRays, size: int
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Yield where rays land on the sensors, some lenses at a time.

    Args:
        family: of lenses.
        values: (L, P).
        rays: of a single lens, which all share; see `shared_rays`.
        size: lenses at a time.

    Yields:
        Which lenses; points (l, N, 2), mm; and which rays go on to the sensor (l, N), inside the
        apertures or not.
    """
    table, column = family.table(values), family.wavelength_columns(rays)
    trace = kernels_of_lenses(rays.position).trace
    for rows in _slices(len(values), size):
        part = replace(table, values=table.values[rows], indices=table.indices[rows])
        own = rays.of_each(len(part.values))
        position, _, _, status, _ = trace(part, (own.position, own.direction, column))
        arrives = (status == int(Status.OK)) | (status == int(Status.VIGNETTED))
        yield rows, position[..., :2], arrives


@torch.no_grad()
def jacobian_parts(
    family: LensFamily,
    values: Tensor,
    rays: FamilyRays,
    size: int,
    outputs: Sequence[str] = ("x", "y"),
) -> Iterator[tuple[slice, FamilyJacobian]]:
    """Yield which lenses, and what `LensFamily.jacobians` returns of them; arguments as above."""
    table, column = family.table(values), family.wavelength_columns(rays)
    variables, weights = family.map_at(values)
    ray_jacobians = kernels_of_lenses(rays.position).ray_jacobians
    for rows in _slices(len(values), size):
        part = replace(table, values=table.values[rows], indices=table.indices[rows])
        own = rays.of_each(len(part.values))
        found = ray_jacobians(
            part,
            variables,
            outputs,
            (own.position, own.direction, column),
            None if weights is None else weights[rows],
        )
        yield rows, FamilyJacobian(*found)


def _slices(count: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, count)) for first in range(0, count, size))
