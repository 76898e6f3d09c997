"""The blur of a perfect lens's finite aperture, put behind geometric point spread functions.

The product of the geometric transfer function and the perfect pupil's is right in both limits, of
rays that all meet in a point and of aberrations of many wavelengths.  In between it errs; how much,
a wave calculation tells.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def diffraction_transfer(
    height: int, width: int, pitch: float, wavelength: float, f_number: float | Tensor
) -> Tensor:
    """The incoherent transfer function of a perfect, round pupil.

    (2/π)·(arccos s - s·√(1 - s²)), with s the frequency over 1/(λN), and zero beyond it (Goodman,
    Introduction to Fourier Optics).

    Args:
        height: of the transform.
        width: of the transform.
        pitch: of the pixels, mm.
        wavelength: nm.
        f_number: N, that the light works with: 1/(2·sin u').

    Returns:
        (height, width/2 + 1), float64, at the frequencies of `rfft2`; differentiable in N once.
    """
    device = f_number.device if isinstance(f_number, Tensor) else torch.device("cpu")
    down = torch.fft.fftfreq(height, dtype=torch.float64, device=device)
    across = torch.fft.rfftfreq(width, dtype=torch.float64, device=device)
    cutoff = pitch / (wavelength * 1e-6 * f_number)
    moved = torch.hypot(down[:, None], across[None]) / cutoff
    s = moved.detach().clamp(max=1.0)
    root = (1.0 - s * s).sqrt()
    found = (torch.arccos(s) - s * root) * (2.0 / math.pi)
    # The slope, -(4/π)·√(1 - s²), is zero at the cutoff, where arccos's own is infinite.
    return found - (4.0 / math.pi) * root * (moved - moved.detach())


def with_diffraction_limit(
    functions: Tensor, pitch: float, wavelengths: Sequence[float], f_number: float | Tensor
) -> Tensor:
    """Functions (..., C, K, K) blurred by the perfect pupil's diffraction at C wavelengths.

    What this spreads beyond the window, 2λN/(π²r) of the light beyond radius r, is given back in
    proportion, so that each function keeps its sum.
    """
    size = functions.shape[-1]
    # As wide as the Airy disc's share beyond it is small, lest its other side come back in.
    side = max(2 * size, 128)
    transfer = torch.stack(
        [diffraction_transfer(side, side, pitch, w, f_number) for w in wavelengths]
    ).to(functions)
    spectrum = torch.fft.rfft2(functions, s=(side, side)) * transfer
    blurred = torch.fft.irfft2(spectrum, s=(side, side))[..., :size, :size]
    kept = blurred.sum((-2, -1), keepdim=True)
    total = functions.sum((-2, -1), keepdim=True)
    return blurred * torch.where(kept > 0.0, total / torch.where(kept > 0.0, kept, 1.0), 0.0)
