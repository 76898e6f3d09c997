"""The motion between readouts of one scene is estimated by its likelihood.

Of readouts y_0 and y_n, each over its noise's deviation, with transfers g_0 and g_n over the same
and light of spectrum S, the Gaussian log-likelihood of a motion s is but for constants

    ½ Σ_f [ S·|ḡ_0·y_0 + ḡ_n·y_n·e^(2πi f·s)|²/(1 + S·|g|²) - log(1 + S·|g|²) ],

|g|² = |g_0|² + |g_n|².  It is a correlation that knows how each of them is blurred, and where noise
rules (Knapp and Carter, IEEE Trans. Acoust. Speech Signal Process. 24, 320, 1976).
"""

import math

import torch
from torch import Tensor

from dolens.reconstruction.readouts import shifted
from dolens.reconstruction.untrained import REFERENCE_VARIANCE
from dolens.reconstruction.wiener import (
    half_spectrum_counts,
    squared_frequency,
    transfer_function,
)

_NEWTON_STEPS, _ROUNDS = 6, 3
# Share of each side over which an image fades out: its edges move by themselves.
_FADING = 0.25


@torch.no_grad()
def estimated_motion(
    raw: Tensor, functions: Tensor, noise: Tensor, reference: int, reach: float
) -> Tensor:
    """Return how far readouts moved against one of them, pixels down and to the right, (B, N, 2).

    Each image is taken to lie at one of the depths, and to move as a whole.  What is found moves
    the images back, and what is left is found again: a window that stands still while they move
    would pull the motion towards zero.

    Args:
        raw: linear light of N readouts, (B, N, 3, H, W).
        functions: of each at D depths, without motion, (N, D, 3, K, K) or (B, N, D, 3, K, K).
        noise: variance at light x is noise[n, 0]·x + noise[n, 1], (N, 2).
        reference: number of the readout that does not move.
        reach: largest motion along each axis, pixels.
    """
    found = torch.zeros(*raw.shape[:2], 2).to(raw)
    for _ in range(_ROUNDS):
        back = shifted(raw, -found[:, :, None]) if bool(found.any()) else raw
        found = found + _motion_left(back, functions, noise, reference, reach)
    return found


def _motion_left(
    raw: Tensor, functions: Tensor, noise: Tensor, reference: int, reach: float
) -> Tensor:
    height, width = raw.shape[-2:]
    size = functions.shape[-1]
    rows, columns = max(height, size), max(width, size)
    light = raw.mean(dim=2)
    mean = light.mean(dim=(-2, -1))
    deviation = ((noise[:, 0] * mean.clamp(min=0.0) + noise[:, 1]) / 3.0).clamp(min=1e-9).sqrt()
    faded = (light - mean[..., None, None]) * _fading(height, width, light)
    seen = torch.fft.rfft2(faded / deviation[..., None, None], s=(rows, columns))
    # Over the deviations (B, N): (B, N, D, R, C).
    transfer = transfer_function(functions.to(raw).mean(dim=-3), rows, columns)
    along = transfer / deviation[..., None, None, None]
    matched = along.conj() * seen[:, :, None]
    square = squared_frequency(rows, columns, raw)
    square[0, 0] = square[0, 1]
    signal = REFERENCE_VARIANCE / 3.0 / square
    count = half_spectrum_counts(columns, square)
    found = torch.zeros(*raw.shape[:2], 2).to(raw)
    for n in range(raw.shape[1]):
        if n == reference:
            continue
        power = along[:, [reference, n]].abs().square().sum(dim=1)
        weight = count * signal / (1.0 + signal * power)
        own = matched[:, [reference, n]].abs().square().sum(dim=1)
        # The windows' mean square, of which the likelihood's area is.
        level = count * (signal * power).log1p() * _fading(height, width, light).square().mean()
        rest = 0.5 * (weight * own - level).sum(dim=(-2, -1))
        cross = weight * matched[:, n] * matched[:, reference].conj()
        moves, peaks = _peaks(cross, rows, columns, reach)
        best = (rest + peaks).argmax(dim=1)
        found[:, n] = moves[torch.arange(len(best)), best]
    return found


def _peaks(cross: Tensor, rows: int, columns: int, reach: float) -> tuple[Tensor, Tensor]:
    """Return where Re Σ cross·e^(2πi f·s) is largest, (B, D, 2), and its value there, (B, D)."""
    area = math.ceil(reach)
    # The full spectrum counts both halves; `cross` has counted them.
    half = cross / half_spectrum_counts(columns, cross.real)
    surface = torch.fft.irfft2(half, s=(rows, columns), norm="forward")
    offsets = torch.arange(-area, area + 1)
    near = surface[..., offsets.remainder(rows), :][..., offsets.remainder(columns)]
    index = near.flatten(-2).argmax(dim=-1)
    width = len(offsets)
    place = torch.stack([index // width - area, index % width - area], dim=-1).to(surface)
    start = place
    down = 2.0 * math.pi * torch.fft.fftfreq(rows).to(surface)[:, None]
    right = 2.0 * math.pi * torch.fft.rfftfreq(columns).to(surface)[None]

    def turned(place: Tensor) -> Tensor:
        phase = down * place[..., :1, None] + right * place[..., 1:, None]
        return cross * torch.exp(1j * phase)

    for _ in range(_NEWTON_STEPS):
        now = turned(place)
        real, imaginary = now.real, now.imag
        slope = torch.stack([-(imaginary * f).sum(dim=(-2, -1)) for f in (down, right)], dim=-1)
        bend = [-(real * f).sum(dim=(-2, -1)) for f in (down**2, down * right, right**2)]
        determinant = bend[0] * bend[2] - bend[1] ** 2
        step = torch.stack(
            [
                bend[2] * slope[..., 0] - bend[1] * slope[..., 1],
                bend[0] * slope[..., 1] - bend[1] * slope[..., 0],
            ],
            dim=-1,
        )
        good = (determinant > 0.0) & (bend[0] < 0.0)
        move = torch.where(good[..., None], -step / determinant[..., None], torch.zeros_like(step))
        # Within a pixel of the whole number, where the peak is.
        place = start + (place + move - start).clamp(-1.0, 1.0)
    return place, turned(place).real.sum(dim=(-2, -1))


def _fading(height: int, width: int, like: Tensor) -> Tensor:
    """Return a window that falls to zero along cosines at the edges, (H, W)."""
    sides = []
    for length in (height, width):
        inner = (torch.arange(length).to(like) + 0.5) / length
        edge = torch.minimum(inner, 1.0 - inner) / _FADING
        sides.append(0.5 - 0.5 * (math.pi * edge.clamp(max=1.0)).cos())
    return sides[0][:, None] * sides[1]
