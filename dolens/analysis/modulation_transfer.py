"""The modulation transfer function (MTF) gives the contrast that a lens leaves of a sinusoidal
pattern.

The geometric transfer function is the Fourier transform of the spot, and so of its rays
(Goodman, Introduction to Fourier Optics, section 6.4; Smith, Modern Optical Engineering, ch. 15).
It says what aberrations leave where they are far larger than the Airy disc; a lens near the
diffraction limit has less contrast than its rays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import AimedAtStop, trace_ray_intercepts
from dolens.analysis.spot_diagram import AIRY, spot_diagram, working_f_numbers
from dolens.errors import InputError, check_choice
from dolens.optics.aiming import field_line
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens

DIRECTIONS = {"sagittal": (1.0, 0.0), "tangential": (0.0, 1.0)}
# Keeps the modulus's slope finite where the transfer function is zero, and changes nothing else.
_TINY = 1e-30


@dataclass(frozen=True)
class Modulation(AtConditions):
    """A `Modulation` holds the polychromatic geometric MTF of F fields at Q frequencies, in double
    precision on the CPU.

    Attributes:
        frequencies: (Q,), cycles/mm on the sensor.
        tangential: (F, Q), of a pattern that varies along the field's own direction, y for one in
            the y-z plane and on the axis; NaN where no light passes.
        sagittal: (F, Q), of one that varies across it.
        diffraction_limit: (Q,), of the paraxial circular pupil, the mean over the wavelengths.
    """

    frequencies: Tensor
    tangential: Tensor
    sagittal: Tensor
    diffraction_limit: Tensor


def modulation_transfer(
    points: Tensor, weights: Tensor, frequencies: Tensor, direction: str | Tensor
) -> Tensor:
    """Return the geometric MTF of spots, |Σ w·exp(-2πi·ν·(p - p̄))| / Σ w.

    Differentiable any number of times in points and weights, but for the kink of the modulus where
    the transfer function is zero.  At ν = 0 its second derivative is -(2π)² times the variance of
    the points along the direction.

    Args:
        points: (..., N, 2), mm on the sensor.
        weights: (N,) or (..., N), of any sum; zero leaves out a ray, wherever it lands.
        frequencies: (Q,), cycles/mm.
        direction: of the change of the pattern: `sagittal` is x and `tangential` y, as for a field
            in the y-z plane; or unit vectors (..., 2).

    Returns:
        (..., Q).

    Raises:
        InputError: shapes do not fit, or another name of a direction.
    """
    if points.ndim < 2 or points.shape[-1] != 2 or weights.shape[-1:] != points.shape[-2:-1]:
        raise InputError(
            f"points must be (..., N, 2) and weights (..., N), not {tuple(points.shape)} and "
            f"{tuple(weights.shape)}"
        )
    if isinstance(direction, str):
        check_choice(direction, DIRECTIONS, "direction")
        direction = points.new_tensor(DIRECTIONS[direction])
    share = weights / weights.sum(-1, keepdim=True)
    height = (points * direction[..., None, :]).sum(-1)
    height = torch.where(weights > 0.0, height, torch.zeros_like(height))
    # The modulus does not know the centroid; small phases are more accurate.
    height = height - (share * height).sum(-1, keepdim=True)
    phase = (2.0 * math.pi) * height[..., None, :] * frequencies[:, None]
    share = share[..., None, :]
    real, imaginary = (share * phase.cos()).sum(-1), (share * phase.sin()).sum(-1)
    return (real.square() + imaginary.square() + _TINY).sqrt()


def diffraction_limited_transfer(
    frequencies: Tensor, wavelength: float | Tensor, f_number: float | Tensor
) -> Tensor:
    """Return the MTF of a circular pupil without aberrations, (2/π)·(arccos s - s·√(1 - s²)), s =
    ν·λ·N.

    Goodman, Introduction to Fourier Optics, equation 6-31; zero from s = 1 on.

    Args:
        frequencies: cycles/mm.
        wavelength: nm.
        f_number: the working F-number N.
    """
    s = (frequencies * wavelength * 1e-6 * f_number).abs().clamp(max=1.0)
    return (2.0 / math.pi) * (torch.arccos(s) - s * (1.0 - s * s).sqrt())


@torch.no_grad()
def modulation(
    lens: Lens,
    where: Conditions,
    frequencies: Sequence[float] | Tensor,
    rays: int = 6000,
    aimed: AimedAtStop | None = None,
) -> Modulation:
    """Compute the polychromatic geometric MTF of a lens from rays spread uniformly over the stop.

    All wavelengths of a field make one spot, so that lateral colour counts.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        frequencies: (Q,), cycles/mm.
        rays: of each field and wavelength, a multiple of four, before apertures clip any.  What is
            left of contrast far beyond the first zero is noise of 1/√rays or less.

    Rarely needed:
        aimed: `aimed_at_stop` of the lens at the wavelengths that count, where several analyses
            share it.

    Raises:
        InputError: a wrong number of rays.
    """
    lens = in_double_precision(lens)
    pupil, weight = uniform_pupil_points(rays)
    # The rim weighs nothing.
    pupil, weight = pupil[weight > 0.0], weight[weight > 0.0]
    where = where.that_count()
    intercepts = trace_ray_intercepts(lens, where, pupil, aimed=aimed)
    light = (weight * intercepts.light * where.weights[:, None]).flatten(1, 2)
    points = intercepts.points.flatten(1, 2)
    frequency = torch.as_tensor(frequencies, dtype=torch.float64).cpu()
    along = field_directions(where)
    across = torch.stack((along[:, 1], -along[:, 0]), -1)
    curves = []
    for spot, share, tangential, sagittal in zip(points, light, along, across, strict=True):
        lit = share > 0.0
        passing = (spot[lit], share[lit], frequency)
        curves.append(
            torch.stack([modulation_transfer(*passing, way) for way in (tangential, sagittal)])
            if bool(lit.any())
            else frequency.new_full((2, len(frequency)), math.nan)
        )
    tangential, sagittal = torch.stack(curves, 1)
    waves, numbers = where.wavelengths, working_f_numbers(lens, where)
    limits = diffraction_limited_transfer(frequency, waves[:, None], numbers[:, None])
    return Modulation(
        where,
        frequency,
        tangential,
        sagittal,
        where.weights @ limits,
    )


@torch.no_grad()
def frequency_range(
    lens: Lens, where: Conditions, count: int = 61, aimed: AimedAtStop | None = None
) -> Tensor:
    """Return frequencies (count,), cycles/mm, from zero to where the sharpest field leaves little.

    A spot of Gaussian profile with the RMS radius r leaves a hundredth of the contrast at 0.68/r;
    the end is that frequency or the cut-off of diffraction where that is lower, rounded up to 1, 2
    or 5 times a power of ten.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        count: frequencies.

    Rarely needed:
        aimed: as `modulation` takes it.

    Raises:
        InputError: the lens is afocal.
    """
    lens = in_double_precision(lens)
    spots = spot_diagram(lens, where.that_count(), 400, aimed)
    cutoff = float((AIRY / spots.airy_radius).min())
    if cutoff == 0.0:
        raise InputError(f"lens '{lens.name}' is afocal: its MTF has no range of frequencies")
    radius = float(spots.polychromatic_rms.nan_to_num(math.inf).min())
    end = min(cutoff, 0.68 / max(radius, 1e-9))
    power = 10.0 ** math.floor(math.log10(end))
    end = next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= 0.999 * end)
    return torch.linspace(0.0, end, count, dtype=torch.float64)


def field_directions(where: Conditions) -> Tensor:
    """Return unit vectors along the fields on the sensor, (F, 2); +y on the axis.

    Args:
        where: fields and object distance.
    """
    field, distance = where.fields, where.object_distance
    line, _ = field_line(torch.deg2rad(field) if where.field_unit == "°" else field, distance)
    across = line[..., :2]
    length = across.norm(dim=-1, keepdim=True)
    return torch.where(length > 0.0, across / length, across.new_tensor([0.0, 1.0]))
