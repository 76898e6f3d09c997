"""Wavefront errors of a lens's fields: RMS, peak to valley and Strehl ratio."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.field_wavefronts import field_wavefronts
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class WavefrontErrors:
    """Wavefront errors of F fields and W wavelengths; NaN where no light passes.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        rms: (F, W), waves, about the best tilt and piston, focus left as it is on the sensor.
        peak_to_valley: (F, W), waves, over the rays that pass, about the same.
        strehl_ratio: (F, W), irradiance where that tilt points over that of a perfect wavefront.
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    rms: Tensor
    peak_to_valley: Tensor
    strehl_ratio: Tensor


@torch.no_grad()
def wavefront_errors(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    object_distance: float | None = None,
    samples: int = 64,
) -> WavefrontErrors:
    """Compute RMS wavefront error, peak to valley and Strehl ratio on the sensor.

    Tilt, which only moves the image point, is removed by least squares over the pupil.  The Strehl
    ratio is |∫A·exp(ik·OPD)|²/(∫A)², and exp(-(2π·rms)²) where errors are small (Maréchal).

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        wavelengths: (W,), nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        samples: rays along each side of a box about each beam.

    Raises:
        InputError: no fields or wavelengths, or a sphere that cannot be placed.
    """
    found = field_wavefronts(lens, fields, wavelengths, object_distance, samples=samples)
    front, shape = found.wavefront, found.lit.shape
    weight = front.weight.flatten(1)
    share = (weight / weight.sum(1, keepdim=True)).nan_to_num(0.0)
    basis = torch.cat([torch.ones_like(share)[..., None], front.direction.flatten(1, 2)], -1)
    waves = front.waves.flatten(1)
    root = share.sqrt()[..., None]
    tilt = torch.linalg.pinv(root * basis) @ (root * waves[..., None])
    error = waves - (basis @ tilt)[..., 0]
    lit = (front.coverage.flatten(1) >= 0.5) & front.valid.flatten(1)
    high = error.where(lit, -torch.inf).amax(1)
    low = error.where(lit, torch.inf).amin(1)
    phase = 2.0 * torch.pi * error
    real, imaginary = (share * phase.cos()).sum(1), (share * phase.sin()).sum(1)

    def values(of: Tensor) -> Tensor:
        return of.cpu().unflatten(0, shape).where(found.lit, torch.nan)

    return WavefrontErrors(
        found.fields,
        found.field_unit,
        found.wavelengths,
        values((share * error.square()).sum(1).sqrt()),
        values((high - low).clamp(min=0.0)),
        values(real.square() + imaginary.square()),
    )
