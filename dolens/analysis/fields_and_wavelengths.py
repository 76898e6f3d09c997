"""Fields and wavelengths of an analysis, as a caller gives them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.errors import InputError


def as_fields_and_wavelengths(
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    device: torch.device | None = None,
) -> tuple[Tensor, Tensor]:
    """Return fields (F, 2), degrees or mm, and wavelengths (W,), nm, in double precision.

    Raises:
        InputError: fields that are not pairs, or none of either.
    """
    field = torch.as_tensor(fields, dtype=torch.float64, device=device)
    if field.ndim != 2 or field.shape[-1] != 2 or len(field) == 0:
        raise InputError(f"fields must be pairs (x, y), at least one, not {fields}")
    wave = torch.as_tensor(wavelengths, dtype=torch.float64, device=device).reshape(-1)
    if len(wave) == 0:
        raise InputError(f"wavelengths must be numbers (nm), at least one, not {wavelengths}")
    return field, wave
