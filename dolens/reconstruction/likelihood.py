"""The depth of each place, and the motion between readouts, are found by likelihood.

The likelihood of each depth at each place chooses among the point spread functions of several.

An image of light of spectrum S through transfer H_d has the spectrum S·|H_d|² + N, N being the
noise's.  A filter of one over its root makes it white where the depth is right, so that the
Gaussian log-likelihood of a neighbourhood is -½ (mean e² + mean log(S·|H_d|² + N)) for each of its
values, e being the filtered image (Levin et al., ACM Trans. Graph. 26, 70, 2007; Zhu et al., IEEE
Trans. Image Process. 22, 4879, 2013).  Contrast and softness of what is there are unknown: S is the
best of several.

Several readouts, each over its noise's deviation, have the covariance 1 + S·g·gᴴ, g_n being H_dn
over that of readout n.  Its root's inverse leaves what is orthogonal to g, and divides what lies
along it by √(1 + S·|g|²), which is its determinant's root.

The motion between readouts of one scene is estimated by its likelihood.

Of readouts y_0 and y_n, each over its noise's deviation, with transfers g_0 and g_n over the same
and light of spectrum S, the Gaussian log-likelihood of a motion s is but for constants

    ½ Σ_f [ S·|ḡ_0·y_0 + ḡ_n·y_n·e^(2πi f·s)|²/(1 + S·|g|²) - log(1 + S·|g|²) ],

|g|² = |g_0|² + |g_n|².  It is a correlation that knows how each of them is blurred, and where noise
rules (Knapp and Carter, IEEE Trans. Acoust. Speech Signal Process. 24, 320, 1976).
"""

import math
from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from dolens.reconstruction.untrained import REFERENCE_VARIANCE
from dolens.reconstruction.wiener import (
    close_periodically,
    half_spectrum_counts,
    padded_lengths,
    shifted,
    squared_frequency,
    transfer_function,
)

# Signal over noise power of luminance at Nyquist's frequency and the reference noise is 1 for most
# photographs; here are its factors, and what is added to the exponent 2 of 1/f².
_CONTRASTS = (0.06, 0.25, 1.0, 4.0, 16.0)
_SLOPES = (-0.6, 0.0, 0.6, 1.2)
# Deviation of the Gaussian neighbourhood, pixels.
_REACH = 8.0
# Share of its values that count as independent: a photograph is no Gaussian field.
_INDEPENDENT = 0.15


@torch.no_grad()
def depth_probabilities(raw: Tensor, functions: Tensor, noise: Tensor) -> Tensor:
    """Return how probable each depth is at each place, all of them alike before one looks.

    It judges by the mean of the colours, and no gradient passes.

    Args:
        raw: linear light, (B, 3, H, W), or of N readouts (B, N, 3, H, W).
        functions: point spread functions of D depths, (D, 3, K, K), K odd, or (N, D, 3, K, K).
        noise: variance at light x is noise[0]·x + noise[1], (2,), or (N, 2).

    Returns:
        (B, D, H, W), of sum 1 over D.
    """
    height, width = raw.shape[-2:]
    functions, noise = functions.to(raw), noise.to(raw)
    if raw.ndim == 4:
        raw, functions, noise = raw[:, None], functions[None], noise[None]
    light = raw.mean(dim=2)
    reach = math.ceil(3.0 * _REACH)
    rows, columns = padded_lengths(height, width, reach, functions.shape[-1])
    transfer = transfer_function(functions.mean(dim=2), rows, columns).transpose(0, 1)
    spectrum = torch.fft.rfft2(close_periodically(light, rows, columns))
    square = squared_frequency(rows, columns, raw)
    square[0, 0] = square[0, 1]
    share = half_spectrum_counts(columns, square) / (rows * columns)
    variance = noise[:, 0] * light.mean(dim=(-2, -1)).clamp(min=0.0) + noise[:, 1]
    deviation = (variance / 3.0).clamp(min=1e-9).sqrt()[..., None, None]  # (B, N, 1, 1)
    spectrum = spectrum / deviation

    def likelihood(depth: int) -> Tensor:
        along = transfer[depth] / deviation
        power = along.abs().square().sum(dim=1, keepdim=True)
        seen = (along.conj() * spectrum).sum(dim=1, keepdim=True)
        seen = along * (seen / power.clamp(min=torch.finfo(power.dtype).tiny))
        beside = spectrum - seen
        found = []
        for contrast, slope in product(_CONTRASTS, _SLOPES):
            signal = contrast * REFERENCE_VARIANCE / 3.0 * square ** (-1.0 - slope / 2.0)
            density = 1.0 + signal * power
            filtered = beside + seen * density.rsqrt()
            filtered[..., 0, 0] = 0.0  # the mean tells nothing of the blur
            white = torch.fft.irfft2(filtered, s=(rows, columns))[..., :height, :width]
            level = (density.log() * share).sum(dim=(-2, -1))  # (B, 1)
            found.append(-0.5 * (_near(white.square().sum(dim=1)) + level[:, None]))
        return torch.stack(found).amax(dim=0)

    values = torch.stack([likelihood(depth) for depth in range(len(transfer))], dim=1)
    # A Gaussian neighbourhood weighs as many values as 4πσ² alike.
    return (values * (_INDEPENDENT * 4.0 * math.pi * _REACH**2)).softmax(dim=1)


def picture_weights(probabilities: Tensor) -> Tensor:
    """Return the shares of D + 1 pictures: those of each depth, and that of none in particular.

    The last takes what the most probable depth is not ahead of chance: its share is 1 where all
    depths are alike, and 0 where one is certain.

    Args:
        probabilities: (B, D, H, W); see `depth_probabilities`.

    Returns:
        (B, D + 1, H, W), of sum 1.
    """
    depths = probabilities.shape[1]
    if depths == 1:
        return torch.cat([probabilities, torch.zeros_like(probabilities)], dim=1)
    ahead = (depths * probabilities.amax(dim=1, keepdim=True) - 1.0) / (depths - 1.0)
    return torch.cat([ahead * probabilities, 1.0 - ahead], dim=1)


def depth_picture(probabilities: Tensor, depths: Sequence[float]) -> Tensor:
    """Return the mean vergence 1/z as a grey picture (B, 3, H, W): black the farthest depth, white
    the nearest.

    Args:
        probabilities: (B, D, H, W); see `depth_probabilities`.
        depths: z, D of them, not all alike.
    """
    vergence = torch.tensor([1.0 / depth for depth in depths]).to(probabilities)
    grey = (vergence - vergence.min()) / (vergence.max() - vergence.min())
    return torch.einsum("bdhw,d->bhw", probabilities, grey)[:, None].expand(-1, 3, -1, -1)


def _near(values: Tensor) -> Tensor:
    """Return means over Gaussian neighbourhoods of images (B, H, W)."""
    reach = math.ceil(3.0 * _REACH)
    offset = torch.arange(-reach, reach + 1).to(values)
    weights = (-0.5 * (offset / _REACH).square()).exp()
    weights = weights / weights.sum()
    # An image smaller than the neighbourhood goes on as its last rows and columns.
    mode = "reflect" if min(values.shape[-2:]) > reach else "replicate"
    beyond = pad(values[:, None], (reach,) * 4, mode=mode)
    return conv2d(conv2d(beyond, weights[None, None, None]), weights[None, None, :, None])[:, 0]


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
