"""Packing without PyTorch's operations, for a lens on the CPU in eager mode.

A record is a few sums of numbers; NumPy takes a fifth of the time to begin one.  The sums are those
of `dolens.optics.packing`, in the same order.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.kernels.operators import kernels_of
from dolens.optics.lens_numbers import LaidOut
from dolens.optics.packing import packed_values, record_indices
from dolens.optics.records import Records

# So many wavelengths' indices are kept.
_WAVELENGTHS = 64


class _Fixed(NamedTuple):
    """A layout's arrays; see `Records`."""

    constants: np.ndarray
    places: np.ndarray
    sources: np.ndarray
    signs: np.ndarray


@lru_cache(maxsize=256)
def _in_precision(layout: Records, dtype: np.dtype) -> _Fixed:
    constants, signs = layout.constants.numpy(), layout.signs.numpy()
    return _Fixed(
        constants.astype(dtype),
        layout.places.numpy(),
        layout.sources.numpy(),
        signs.astype(dtype),
    )


def eager_values(found: LaidOut) -> Tensor:
    """Return what `packed_values` does, without a graph."""
    numbers = kernels_of(found.scalars[0]).read(found.scalars)
    if numbers is None:
        return packed_values(found.layout, found.scalars, found.arrays).detach()
    if found.arrays:
        parts = (array.detach().reshape(-1).numpy() for array in found.arrays)
        numbers = np.concatenate([numbers, *(part.astype(numbers.dtype) for part in parts)])
    fixed = _in_precision(found.layout, numbers.dtype)
    values = fixed.constants.copy()
    np.add.at(values, fixed.places, numbers[fixed.sources] * fixed.signs)
    return torch.from_numpy(values)


def eager_cotangents(layout: Records, of_values: np.ndarray, count: int) -> Tensor:
    """Return what `cotangents_of_numbers` does."""
    fixed = _in_precision(layout, of_values.dtype)
    found = np.zeros(count, of_values.dtype)
    np.add.at(found, fixed.sources, of_values[fixed.places] * fixed.signs)
    return torch.from_numpy(found)


def eager_indices(found: LaidOut, wavelength: float | Tensor) -> Tensor:
    """Return what `record_indices` does; of a number a tensor that is kept, not to be changed."""
    if not isinstance(wavelength, (int, float)):
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
