"""Packing without PyTorch's operations, for a lens on the CPU in eager mode.

A record is a few sums of numbers; one call of a kernel takes a fifth of the time that PyTorch's
operations take to begin.  The sums are those of `dolens.optics.packing`, in the same order.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.kernels.operators import kernels_of
from dolens.kernels.table import SurfaceTable
from dolens.optics.lens_numbers import LaidOut
from dolens.optics.packing import packed_values, record_indices
from dolens.optics.records import Records

# So many wavelengths' indices are kept.
_WAVELENGTHS = 64


class Prepared(NamedTuple):
    """What calls for the same layout in one precision have in common.

    Attributes:
        kernels: the module of the CPU's.
        numbers: how records are made of numbers; see `kernels.cpu.stored_numbers`.
        frames: of the kernels' programs.
    """

    kernels: Any
    numbers: Any
    frames: dict[bool, Any]


@cached_tensors(maxsize=256)
def prepared(layout: Records, dtype: torch.dtype) -> Prepared:
    """Return what calls share."""
    kernels = kernels_of(layout.constants)
    numbers = kernels.StoredNumbers(
        layout.constants, layout.places, layout.sources, layout.signs, layout.count, dtype
    )
    return Prepared(kernels, numbers, {})


def eager_table(found: LaidOut, indices: Tensor) -> SurfaceTable:
    """Return the table of a lens, its values those of `packed_values` without a graph."""
    layout, scalars = found.layout, found.scalars
    values = prepared(layout, scalars[0].dtype).numbers.records(scalars, found.arrays)
    if values is None:
        values = packed_values(layout, scalars, found.arrays).detach()
    return SurfaceTable(values, indices.contiguous(), layout.codes, layout.extras)


def eager_indices(found: LaidOut, wavelength: float | Tensor) -> Tensor:
    """Return what `record_indices` does; of a number a tensor that is kept, not to be changed."""
    if found.offsets or not isinstance(wavelength, (int, float)):
        return record_indices(found, wavelength, found.scalars[0].device)
    known = found.indices.get(wavelength)
    if known is None:
        if len(found.indices) >= _WAVELENGTHS:
            found.indices.clear()
        # A tensor made in inference mode could never be saved for a backward pass.
        with torch.inference_mode(False):
            known = record_indices(found, wavelength, found.scalars[0].device)
        found.indices[wavelength] = known
    return known
