"""Wiener deconvolution uses a prior for natural images, and is differentiable in all of its
arguments.
"""

import math

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional


def wiener_deconvolve(
    image: Tensor,
    point_spread_function: Tensor,
    noise_to_signal: Tensor | float,
    margin: int,
) -> Tensor:
    """Undo a blur by the linear filter of least expected squared error.

    The image model is a true convolution plus white noise,

        image[i] = Σ_j psf[K//2 + i − j] true[j] + noise[i],

    and natural images have a power spectrum ∝ 1/f², so noise over signal grows as f².  With H
    the transfer function (the transform of the point spread function, its pixel (K//2, K//2)
    taken as the origin) the filter is

        W(f) = conj(H) / max(|H|² + r (f / f_N)², ε),   f² = f_x² + f_y²,   f_N = 1/2 cycle/pixel,

    r being noise over signal power at the Nyquist frequency f_N along an axis.  At f = 0 the
    gain is 1/H(0): exactly 1 for a point spread function of unit sum, so a uniform image stays
    what it is; a lens that loses light has it restored.  The floor ε, the machine epsilon of
    the dtype, only keeps frequencies without any signal finite.

    The discrete transform sees the image as periodic.  Each axis is therefore extended by at
    least 2·`margin` pixels, in which the last row (column) turns into the first along a
    raised cosine: near each edge this repeats the edge, and opposite edges meet without a
    step.  The lengths are rounded up to products of 2, 3 and 5, and the result is cropped.

    Args:
        image: linear light, (B, C, H, W), float32 or float64; its dtype is computed in.
        point_spread_function: (C, K, K), K odd, centred on the pixel (K//2, K//2).
        noise_to_signal: r > 0, one number or one a channel, (C,).
        margin: pixels at each edge, at least 0; K//2 keeps light from reaching across.

    Returns:
        (B, C, H, W), not clamped.  Gradients reach all three tensors.

    Raises:
        ValueError: an even or oblong point spread function, channels that do not match, or a
            negative margin.
    """
    channels, height, width = image.shape[-3:]
    _check(channels, point_spread_function, margin)
    rows, columns = padded_lengths(height, width, margin, point_spread_function.shape[-1])
    weight = wiener_filter(point_spread_function.to(image), noise_to_signal, rows, columns)
    spectrum = torch.fft.rfft2(close_periodically(image, rows, columns))
    restored = torch.fft.irfft2(spectrum * weight, s=(rows, columns))
    return restored[..., :height, :width]


def padded_lengths(height: int, width: int, margin: int, size: int) -> tuple[int, int]:
    """Return rows and columns of the transform of an image.

    Args:
        height: of the image, pixels.
        width: of the image, pixels.
        margin: pixels added at each edge, at least.
        size: side of the point spread function, pixels.
    """
    rows = next_fast_len(max(height + 2 * margin, size), real=True)
    return rows, next_fast_len(max(width + 2 * margin, size), real=True)


def wiener_filter(
    point_spread_function: Tensor, noise_to_signal: Tensor | float, rows: int, columns: int
) -> Tensor:
    """Return W(f) on the grid of `torch.fft.rfft2`, (C, rows, columns//2 + 1), complex.

    Args:
        point_spread_function: (C, K, K), K odd; its dtype is computed in.
        noise_to_signal: r > 0, one number or one a channel, (C,).
        rows: of the padded image.
        columns: of the padded image.
    """
    like = point_spread_function
    ratio = torch.as_tensor(noise_to_signal, dtype=like.dtype, device=like.device)
    transfer = transfer_function(point_spread_function, rows, columns)
    prior = squared_frequency(rows, columns, like) * ratio.reshape(-1, 1, 1)
    power = transfer.real**2 + transfer.imag**2
    # A floor and not a sum, so that the gain at f = 0 stays exact.
    return transfer.conj() / (power + prior).clamp(min=torch.finfo(like.dtype).eps)


def _check(channels: int, point_spread_function: Tensor, margin: int) -> None:
    shape = tuple(point_spread_function.shape)
    if len(shape) != 3 or shape[1] != shape[2] or shape[1] % 2 == 0:
        raise ValueError(f"point spread function of shape {shape}: expected (C, K, K) with K odd")
    if shape[0] != channels:
        raise ValueError(
            f"point spread function of {shape[0]} channels for an image of {channels} channels"
        )
    if margin < 0:
        raise ValueError(f"margin={margin}: must be at least 0 pixels")


def transfer_function(point_spread_function: Tensor, rows: int, columns: int) -> Tensor:
    """Return H(f) on the grid of `torch.fft.rfft2`, (..., rows, columns//2 + 1), complex.

    Args:
        point_spread_function: (..., K, K), K odd, whose pixel (K//2, K//2) is the origin.
        rows: of the padded image, at least K.
        columns: of the padded image, at least K.
    """
    size = point_spread_function.shape[-1]
    padded = functional.pad(point_spread_function, (0, columns - size, 0, rows - size))
    # The centre goes to the origin, the part before it wraps to the far end.
    centred = torch.roll(padded, shifts=(-(size // 2), -(size // 2)), dims=(-2, -1))
    return torch.fft.rfft2(centred)


def half_spectrum_counts(columns: int, like: Tensor) -> Tensor:
    """Return for how many frequencies each column of `torch.fft.rfft2` stands, (columns // 2 + 1,).

    Two, as a real image has the same power at a frequency and at its opposite; one in the first,
    and where the number of columns is even in the last.
    """
    counts = like.new_full((columns // 2 + 1,), 2.0)
    counts[0] = 1.0
    if columns % 2 == 0:
        counts[-1] = 1.0
    return counts


def squared_frequency(rows: int, columns: int, like: Tensor) -> Tensor:
    """Return (f / f_N)² on the grid of `torch.fft.rfft2`, (rows, columns//2 + 1), in the dtype and
    on the device of `like`; f_N = 1/2 cycle/pixel along an axis.
    """
    vertical = torch.fft.fftfreq(rows, dtype=like.dtype, device=like.device) / 0.5
    horizontal = torch.fft.rfftfreq(columns, dtype=like.dtype, device=like.device) / 0.5
    return vertical[:, None] ** 2 + horizontal[None, :] ** 2


def close_periodically(image: Tensor, rows: int, columns: int) -> Tensor:
    """Extend an image (..., H, W) to (..., rows, columns) so that opposite edges meet.

    The bridge is appended after the last row; being periodic, it also lies before the first.
    """
    for dimension, length in ((-2, rows), (-1, columns)):
        gap = length - image.shape[dimension]
        step = torch.arange(1, gap + 1, dtype=image.dtype, device=image.device) / (gap + 1)
        blend = 0.5 - 0.5 * torch.cos(math.pi * step)
        if dimension == -2:
            blend = blend[:, None]
        last = image.narrow(dimension, image.shape[dimension] - 1, 1)
        first = image.narrow(dimension, 0, 1)
        image = torch.cat([image, last + blend * (first - last)], dim=dimension)
    return image
