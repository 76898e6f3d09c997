"""The modulation transfer function as the Fourier transform of Huygens's point spread function."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.analysis.modulation_transfer import field_directions
from dolens.diffraction.huygens import huygens_point_spread, huygens_window
from dolens.diffraction.transfer import DiffractionModulation
from dolens.optics.lens import Lens

# Airy radii that the window is wider, on every side, than that of a point spread function; and
# points of the image to an Airy radius: three leave the copies of a spectrum that ends at 1.22 over
# the radius well apart.
_AIRY_RADII, _STEPS = 4.0, 3.0


@torch.no_grad()
def huygens_modulation(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    frequencies: Sequence[float] | Tensor,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | None = None,
) -> DiffractionModulation:
    """Compute the polychromatic MTF from sums of Huygens's wavelets.

    It needs no Fourier transform of the pupil, and so holds where that does not (see
    `dolens.diffraction.huygens`).  The modulation is that of all light: what falls outside of the
    window, a hundredth or two, is missing at frequencies below one over the window's width, and
    `sampling_error` counts it.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        wavelengths: (W,), nm.
        frequencies: (Q,), cycles/mm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        wavelength_weights: (W,), of any sum; None: see `spectral_shares`.

    Returns:
        The curves; the limits, which need a second pupil, are NaN.

    Raises:
        InputError: as `huygens_point_spread`.
    """
    frequency = torch.as_tensor(frequencies, dtype=torch.float64).cpu().reshape(-1)
    points = torch.as_tensor(fields, dtype=torch.float64).cpu()
    arguments = wavelengths, object_distance, wavelength_weights
    along = field_directions(points, object_distance)
    unknown = torch.full_like(frequency, math.nan)
    curves: list[Tensor] = []
    errors: list[float] = []
    diffraction: list[bool] = []
    reasons: list[str] = []
    for field, way in zip(points, along, strict=True):
        half, airy = huygens_window(lens, field, *arguments)
        half += _AIRY_RADII * airy
        cells = math.ceil(2.0 * half * _STEPS / airy)
        found = huygens_point_spread(lens, field[None], *arguments, cells, half)
        reasons += found.reasons
        diffraction += found.diffraction
        if not found.diffraction[0]:
            curves.append(torch.stack((unknown, unknown)))
            errors.append(math.nan)
            continue
        ways = torch.stack((way, torch.stack((way[1], -way[0]))))
        curves.append(_transform(found.irradiance[0], float(found.half_width_um), frequency, ways))
        errors.append(float(found.sampling_error) + abs(1.0 - float(found.held)))
    tangential, sagittal = torch.stack(curves, 1)
    limit = unknown.expand(len(points), -1)
    return DiffractionModulation(
        points,
        found.field_unit,
        found.wavelengths,
        frequency,
        tangential,
        sagittal,
        limit,
        limit,
        tuple(diffraction),
        tuple(reasons),
        torch.tensor(errors, dtype=torch.float64),
    )


def _transform(irradiance: Tensor, half_um: float, frequency: Tensor, ways: Tensor) -> Tensor:
    """Return |∬E·exp(-2πi·ν·(p·way))|, (2, Q), of irradiance (M, M) in shares per µm²."""
    cells = len(irradiance)
    step = 2.0 * half_um / cells
    place = 1e-3 * ((torch.arange(cells).to(irradiance) + 0.5) * step - half_um)
    found = []
    for x, y in ways.tolist():
        # exp(-2πi·ν·(x·X + y·Y)) is a product of one of columns and one of rows.
        across, down = (
            torch.polar(torch.ones_like(phase), phase)
            for phase in (-2.0 * math.pi * frequency[:, None] * w * place for w in (x, y))
        )
        sums = ((down @ irradiance.to(down)) * across).sum(-1)
        found.append(step * step * sums.abs())
    return torch.stack(found)
