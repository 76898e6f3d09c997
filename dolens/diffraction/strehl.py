"""The Strehl ratio over the field: from the peak of the point spread function, and by Maréchal."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.diffraction.point_spread import point_spread
from dolens.diffraction.wavefront_error import wavefront_errors
from dolens.optics.lens import Lens

# Of a point spread function's window, whose peak alone counts.
_CELLS = 64


@dataclass(frozen=True)
class StrehlRatios:
    """Strehl ratios of F fields at W wavelengths, each alone, on the sensor as it stands.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        peak: (F, W), highest irradiance of the point spread function over that of the same pupil
            without aberrations (Strehl); NaN where no light passes, or where the wavefront is too
            steep for diffraction.
        marechal: (F, W), exp(-(2πσ)²), σ being the RMS wavefront error in waves about its best tilt
            and piston (Maréchal's, as Mahajan has it; good above some 0.3).
        sampling_error: (F, W), of the point spread function; see `point_spread`.
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    peak: Tensor
    marechal: Tensor
    sampling_error: Tensor


@torch.no_grad()
def strehl_ratios(
    lens: Lens,
    fields: Sequence[Sequence[float]] | FieldScan | Tensor,
    wavelengths: Sequence[float] | Tensor,
    object_distance: float | None = None,
) -> StrehlRatios:
    """Compute Strehl ratios of every field and wavelength in both ways.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them, or a scan of them.
        wavelengths: (W,), nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Raises:
        InputError: no fields or wavelengths, or a sphere that cannot be placed.
    """
    points = fields.fields if isinstance(fields, FieldScan) else fields
    errors = wavefront_errors(lens, points, wavelengths, object_distance)
    peak, sampling = [], []
    for wavelength in errors.wavelengths.tolist():
        found = point_spread(lens, points, [wavelength], object_distance, cells=_CELLS)
        peak.append(found.strehl_ratio)
        sampling.append(found.sampling_error)
    return StrehlRatios(
        errors.fields,
        errors.field_unit,
        errors.wavelengths,
        torch.stack(peak, -1),
        marechal(errors.rms),
        torch.stack(sampling, -1),
    )


def marechal(rms: Tensor) -> Tensor:
    """Return exp(-(2πσ)²) of RMS wavefront errors σ in waves."""
    return (-(2.0 * torch.pi * rms).square()).exp()
