"""Point spread functions on pixels, of pupils that are known at any sampling."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.diffraction.pixel_psf import fine_grid, pixel_matrix
from dolens.diffraction.propagation import fourier_field
from dolens.diffraction.pupil_fit import RegularPupil
from dolens.diffraction.wavefront import MM_PER_NM
from dolens.rendering.psf import splat

# Samples across a pupil for the rays' moments, fewest and most for a Fourier transform, and for
# rays alone.
_MOMENTS, _FEWEST, _MOST, _RAYS = 48, 64, 320, 224
# Airy radii that a window holds around the rays: beyond are 2 % of a perfect lens's light.
_AIRY_RADII = 8.0
# Samples of a pupil over those at which a copy of the spot meets the window.
_OVERSAMPLING = 1.2


@dataclass(frozen=True)
class PupilRays:
    """Rays of N pupils, regular in the direction cosines, at two sensor positions.

    Attributes:
        intercept: (N, G, G, 2), mm on the sensor from the window's centre.
        slope: (N, G, G, 2), by which the intercept changes where the sensor is moved by 1 mm, the
            middle of the pupil held.
        weight: (N, G, G), share of the light.
    """

    intercept: Tensor
    slope: Tensor
    weight: Tensor

    def moments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return variance of the intercept, its covariance with the slope, and the slope's
        variance, each (N,); so the mean square spot radius at a focus shift is a quadratic.
        """
        weight = self.weight[..., None]
        a = self.intercept - (weight * self.intercept).sum((1, 2), keepdim=True)
        b = self.slope - (weight * self.slope).sum((1, 2), keepdim=True)
        return tuple((weight * p).sum((1, 2, 3)) for p in (a * a, a * b, b * b))  # type: ignore[return-value]

    def reach(self, shift: float) -> float:
        """Return the largest |x| or |y| (mm) of the rays that carry light."""
        lit = self.weight > 1e-3 * self.weight.amax((1, 2), keepdim=True)
        return float((self.intercept + shift * self.slope)[lit].abs().amax())


def pupil_rays(pupil: RegularPupil) -> PupilRays:
    """Return the rays that are normal to the wavefronts: -∂OPD/∂α over the index.

    Args:
        pupil: of N wavefronts.
    """
    step = (pupil.cosines[..., 1] - pupil.cosines[..., 0])[:, :, None, None]

    def gradient(values: Tensor) -> Tensor:
        down, across = torch.gradient(values, dim=(1, 2))
        return torch.stack((-across / step[:, 0], -down / step[:, 1]), -1)

    intercept = gradient(pupil.opd) / pupil.index[:, None, None, None]
    light = pupil.amplitude.square()
    return PupilRays(
        intercept, gradient(focus_path(pupil)), light / light.sum((1, 2), keepdim=True)
    )


def focus_path(pupil: RegularPupil) -> Tensor:
    """Return by how much paths to the sensor grow where it moves by 1 mm in air, (N, G, G).

    It is the cosine γ to the axis, less its tangent plane at the pupil's middle: images are
    centred on the ray from there.
    """
    middle = pupil.cosines.mean(-1)[..., None, None]
    x, y = pupil.cosines[:, 0, None, :], pupil.cosines[:, 1, :, None]
    gamma = (1.0 - x * x - y * y).clamp(min=1e-6).sqrt()
    there = (1.0 - middle.square().sum(1)).clamp(min=1e-6).sqrt()
    tilt = (middle[:, 0] * (x - middle[:, 0]) + middle[:, 1] * (y - middle[:, 1])) / there
    return gamma - there + tilt


@torch.no_grad()
def pixel_functions(
    pupil_at: Callable[[int], RegularPupil],
    shifts: Sequence[float],
    pitch: float,
    size: int = 65,
) -> tuple[Tensor, float]:
    """Compute the point spread functions of N pupils at D positions of the sensor.

    By the Fourier transform of the pupil, or, where a wavefront is too steep for it, by rays.  Each
    is the irradiance convolved with a quadratic B-spline, as in `wave_kernels`.

    Args:
        pupil_at: returns the N pupils with so many samples across.
        shifts: mm, D of them, of the sensor.
        pitch: mm, of the pixels.
        size: K, odd.

    Returns:
        (D, N, K, K), of unit sum, and the least share of the light that a window holds.
    """
    rough = pupil_at(_MOMENTS)
    coarse = pupil_rays(rough)
    wave = MM_PER_NM * rough.wavelength / rough.index
    step = rough.cosines[..., 1] - rough.cosines[..., 0]
    airy = 1.22 * float(wave.amax() / (_MOMENTS * step).amin())
    # Turns of the phase across the pupil that a millimetre on the sensor makes.
    turns = float((_MOMENTS * step / wave[:, None]).amax())
    half = size // 2
    found: dict[float, Tensor] = {}
    held = 1.0
    rays: PupilRays | None = None
    pupils: dict[int, RegularPupil] = {}
    for shift in dict.fromkeys(shifts):
        reach = coarse.reach(shift)
        h = min(half, math.ceil((reach + _AIRY_RADII * airy) / pitch) + 1)
        needed = _OVERSAMPLING * turns * (reach + (h + 1.5) * pitch)
        if needed <= _MOST:
            samples = max(_FEWEST, 32 * math.ceil(needed / 32.0))
            if samples not in pupils:
                pupils[samples] = pupil_at(samples)
            pupil = pupils[samples]
            kernels, share = _by_waves(pupil, shift, pitch, 2 * h + 1)
        else:
            rays = rays or pupil_rays(pupil_at(_RAYS))
            kernels, share = _by_rays(rays, shift, pitch, 2 * h + 1)
        found[shift] = torch.nn.functional.pad(kernels, [half - h] * 4)
        held = min(held, share)
    return torch.stack([found[shift] for shift in shifts]), held


def _by_waves(pupil: RegularPupil, shift: float, pitch: float, size: int) -> tuple[Tensor, float]:
    moved = replace(pupil, opd=pupil.opd + shift * pupil.index[:, None, None] * focus_path(pupil))
    wave = MM_PER_NM * pupil.wavelength / pupil.index
    width = (pupil.cosines[..., -1] - pupil.cosines[..., 0]).amax(-1)
    cells = math.ceil(float((width / wave).amax()) * pitch + 2.0)
    fine = pitch * fine_grid(size, cells, pupil.opd)
    field = fourier_field(moved, -fine, fine, torch.float32)
    irradiance = field.real.square() + field.imag.square()
    matrix = (pitch / cells) * pixel_matrix(size, cells, irradiance)
    kernels = matrix @ irradiance @ matrix.mT
    total = kernels.sum((-2, -1))
    return kernels / total[:, None, None], float((total / pupil.flux).amin())


def _by_rays(rays: PupilRays, shift: float, pitch: float, size: int) -> tuple[Tensor, float]:
    landed = ((rays.intercept + shift * rays.slope) / pitch).float().flatten(1, 2)
    weight = rays.weight.float().flatten(1)
    middle = size // 2
    kernels = splat(middle + landed[..., 1], middle - landed[..., 0], weight, size, fused=True)
    total = kernels.sum((-2, -1))
    return kernels / total[:, None, None], float(total.amin())
