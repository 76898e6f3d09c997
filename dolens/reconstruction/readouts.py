"""Several readouts of one scene are restored together, as those of a focus bracket.

Readout n of light x is y_n = h_n∗x + noise of variance v_n.  Multiplied by √w_n, w_n = v/v_n with
1/v = Σ 1/v_n, all of them have the noise v, and their least-squares problem is that of one image
with Σ_n as one more sum: nothing is lost, and one readout is what it was.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.reconstruction.wiener import close_periodically

# Of the noise's variance for each unit of light: without noise there is nothing to even out, and a
# thousandth of the reference's is invisible.
LEAST_SHOT = 1e-5
# The light that weights and filters take for that of all pixels: the mean of photographs.
MEAN_LIGHT = 0.2


class Readouts(NamedTuple):
    """Readouts whose noise is alike.

    Attributes:
        images: √w_n·y_n, (B, N, 3, H, W).
        functions: √w_n·h_n of D depths, (N, D, 3, K, K).
        mean: Σ w_n·y_n, (B, 3, H, W).
        noise: its variance at light x is noise[0]·x + noise[1], (2,).
    """

    images: Tensor
    functions: Tensor
    mean: Tensor
    noise: Tensor


def readouts_of(raw: Tensor, functions: Tensor, noise: Tensor) -> Readouts:
    """Return the readouts of images, weighted by their noise at the light of most photographs.

    Args:
        raw: linear light, (B, 3, H, W), or of N readouts (B, N, 3, H, W).
        functions: point spread functions of D depths, (D, 3, K, K), or (N, D, 3, K, K).
        noise: variance at light x is noise[0]·x + noise[1], (2,), or (N, 2).

    Raises:
        InputError: the numbers of readouts differ.
    """
    functions, noise = functions.to(raw), noise.to(raw)
    if raw.ndim == 4:
        return Readouts(raw[:, None], functions[None], raw, noise)
    if not raw.shape[1] == len(functions) == len(noise):
        raise InputError(
            f"{raw.shape[1]} readouts, point spread functions of {len(functions)}, and the noise "
            f"of {len(noise)}: must be as many"
        )
    precision = 1.0 / (MEAN_LIGHT * noise[:, 0].clamp(min=LEAST_SHOT) + noise[:, 1])
    weights = precision / precision.sum()
    each = weights[:, None, None, None]
    return Readouts(
        each.sqrt() * raw,
        each.sqrt()[..., None] * functions,
        (each * raw).sum(dim=1),
        (weights.square()[:, None] * noise).sum(dim=0),
    )


def shifted(images: Tensor, pixels: Tensor) -> Tensor:
    """Return images moved by fractions of pixels, (..., H, W).

    They are taken for samples of functions that have no frequency above Nyquist's, as which the
    shift is exact; what lies beyond their edges is a bridge to the opposite edge.

    Args:
        images: (..., H, W).
        pixels: down and to the right, (..., 2), of shapes that broadcast with the images'.
    """
    height, width = images.shape[-2:]
    reach = 8 + 2 * int(pixels.detach().abs().max().ceil())
    # Odd lengths have no frequency that is its own opposite.
    rows, columns = (n + reach + (n + reach + 1) % 2 for n in (height, width))
    closed = close_periodically(images, rows, columns)
    down = torch.fft.fftfreq(rows).to(images)[:, None] * pixels[..., 0, None, None].to(images)
    right = torch.fft.rfftfreq(columns).to(images) * pixels[..., 1, None, None].to(images)
    turn = torch.exp(-2j * torch.pi * (down + right))
    moved = torch.fft.irfft2(torch.fft.rfft2(closed) * turn, s=(rows, columns))
    return moved[..., :height, :width]
