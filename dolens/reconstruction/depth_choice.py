"""The likelihood of each depth at each place chooses among the point spread functions of several.

An image of light of spectrum S through transfer H_d has the spectrum S·|H_d|² + N, N being the
noise's.  A filter of one over its root makes it white where the depth is right, so that the
Gaussian log-likelihood of a neighbourhood is -½ (mean e² + mean log(S·|H_d|² + N)) for each of its
values, e being the filtered image (Levin et al., ACM Trans. Graph. 26, 70, 2007; Zhu et al., IEEE
Trans. Image Process. 22, 4879, 2013).  Contrast and softness of what is there are unknown: S is the
best of several.

Several readouts, each over its noise's deviation, have the covariance 1 + S·g·gᴴ, g_n being H_dn
over that of readout n.  Its root's inverse leaves what is orthogonal to g, and divides what lies
along it by √(1 + S·|g|²), which is its determinant's root.
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
