"""The optical transfer function of a pupil along one direction, its normalised autocorrelation."""

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from dolens.diffraction.pupil_fit import RegularPupil
from dolens.diffraction.wavefront import MM_PER_NM

# Rows of a pupil that are transformed at a time: they stay in a processor's cache.
_ROWS = 64


def transfer_functions(
    pupil: RegularPupil, axis: int, frequencies: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the optical transfer functions of a pupil along one axis, and those of the same pupil
    without aberrations.

    The transfer function is the pupil's autocorrelation (Goodman, Introduction to Fourier Optics,
    section 6.3).  It comes from the line spread function, whose samples are the squared moduli of
    Fourier transforms of the pupil's rows, summed.  Phases are formed in double precision; the
    transforms are of single precision, and err by 1e-6.

    Args:
        pupil: of W wavelengths and G × G cells.
        axis: of `pupil.cosines`: 0 for the last dimension, 1 for the one before.
        frequencies: (Q,), cycles/mm.

    Returns:
        (W, Q), complex, 1 at zero; and the same without aberrations.
    """
    count = pupil.amplitude.shape[-1]
    size = next_fast_len(2 * count)
    steps = pupil.cosines[..., 1] - pupil.cosines[..., 0]
    # A cell that passes a share c has amplitude c, but flux c and not c²: the autocorrelation at
    # zero, the mean of its transform, lacks the difference.
    lacking = pupil.flux / steps.prod(-1) - pupil.amplitude.square().sum((-2, -1))
    spread = _line_spreads(pupil, axis, size) + lacking[:, None, None]
    spread = spread / spread.sum(-1, keepdim=True)
    step = steps[:, axis]
    wave = MM_PER_NM * pupil.wavelength / pupil.index
    order = torch.fft.fftfreq(size, dtype=torch.float64, device=spread.device)
    # U(ρ) goes with exp(+ikρα), and the transform with exp(-i…): sample j lies at -j·λ/(n'·Δα).
    place = -(wave / step)[:, None] * order
    phase = -2.0 * torch.pi * frequencies[:, None] * place[:, None]
    found = torch.complex(spread @ phase.cos().mT, spread @ phase.sin().mT)
    # Beyond the autocorrelation's support only its periodic copies are left.
    beyond = (frequencies * wave[:, None]).abs() >= (step * count)[:, None]
    found, perfect = found.masked_fill(beyond[:, None], 0.0).unbind(1)
    return found, perfect


def _line_spreads(pupil: RegularPupil, axis: int, size: int) -> Tensor:
    """Return line spread functions (W, 2, `size`), in the order of a Fourier transform, with and
    without aberrations.
    """
    spreads = []
    for amplitude, opd, wavelength in zip(
        pupil.amplitude, pupil.opd, pupil.wavelength, strict=True
    ):
        aberrated = perfect = amplitude.new_zeros(())
        if axis == 1:
            amplitude, opd = amplitude.mT, opd.mT
        for rows, paths in zip(amplitude.split(_ROWS), opd.split(_ROWS), strict=True):
            turns = paths / (MM_PER_NM * wavelength)
            turns = (2.0 * torch.pi * (turns - turns.round())).float()
            rows = rows.float()
            line = torch.fft.fft(torch.polar(rows, turns), size)
            aberrated = aberrated + (line.real.square() + line.imag.square()).double().sum(0)
            line = torch.fft.rfft(rows, size)
            perfect = perfect + (line.real.square() + line.imag.square()).double().sum(0)
        # The transform of real values is symmetric; only its half is computed.
        other = perfect[1 : (size + 1) // 2].flip(0)
        spreads.append(torch.stack((aberrated, torch.cat([perfect, other]))))
    return torch.stack(spreads)
