"""Wiener deconvolution uses a prior for natural images, and is differentiable in all of its
arguments.

Several readouts of one scene are restored together, as those of a focus bracket.

Readout n of light x is y_n = h_n∗x + noise of variance v_n.  Multiplied by √w_n, w_n = v/v_n with
1/v = Σ 1/v_n, all of them have the noise v, and their least-squares problem is that of one image
with Σ_n as one more sum: nothing is lost, and one readout is what it was.

The least mean squared error of any linear filter is computed from transfer functions.

A cross-check of trained cameras that takes milliseconds and no photographs.  Where the depth of a
pixel is unknown one filter serves all depths; where it is known each depth has its own.  A network
that guesses depths from what it sees lies in between.
"""

import math
from typing import Any, NamedTuple

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError


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


class LinearError(NamedTuple):
    """A `LinearError` holds mean squared errors of D depths, in the image's units squared, each
    (..., D).

    Attributes:
        common_filter: one filter for all depths, of least mean error over them.
        filter_per_depth: each depth has the filter that is best for it.
    """

    common_filter: Tensor
    filter_per_depth: Tensor


def natural_spectrum(
    rows: int, columns: int, variance: float, outer_scale: float, like: Tensor
) -> Tensor:
    """Return the power spectrum of natural images, S ∝ 1/(f² + f₀²) without its mean.

    Field (J. Opt. Soc. Am. A 4, 2379, 1987) has 1/f²; f₀ keeps low frequencies finite.

    Args:
        rows: of the transform.
        columns: of the image; the transform has columns // 2 + 1.
        variance: of the image, which S averages to over all frequencies.
        outer_scale: pixels; f₀ = 1/outer_scale cycles a pixel.
        like: gives dtype and device.

    Returns:
        (rows, columns // 2 + 1), zero at the origin.
    """
    options: dict[str, Any] = {"dtype": like.dtype, "device": like.device}
    down = torch.fft.fftfreq(rows, **options)[:, None]
    across = torch.fft.rfftfreq(columns, **options)[None]
    power = 1.0 / (down.square() + across.square() + outer_scale**-2)
    power[0, 0] = 0.0
    return power * (variance / _mean(power, columns))


def linear_error(functions: Tensor, spectrum: Tensor, noise: float) -> LinearError:
    """Return the least errors of restoring an image of spectrum S that was blurred and got white
    noise.

    With transfer functions H_d and noise of variance N a pixel, a filter W leaves at depth d the
    error e_d = ⟨|1 - W·H_d|²·S + |W|²·N⟩, ⟨⟩ the mean over frequencies.  The mean of e_d over d is
    least for W = S·mean(H_d*)/(S·mean|H_d|² + N), Wiener's filter where there is one depth.

    Args:
        functions: (..., D, K, K), point spread functions, K odd.
        spectrum: (R, C // 2 + 1) with C = R even and at least K.
        noise: N.

    Returns:
        errors of D depths.
    """
    return linear_error_of_readouts(functions.unsqueeze(-4), spectrum, noise)


def linear_error_of_readouts(functions: Tensor, spectrum: Tensor, noise: float) -> LinearError:
    """Return the least errors of restoring an image that was read out several times.

    As `linear_error`, with a filter for each readout: |1 - Σ_n W_n·H_nd|²·S + Σ_n |W_n|²·N, and
    sums over n of mean|H_nd|².

    Args:
        functions: (..., readouts, D, K, K), scaled so that all have the same noise; see
            `readouts_of`.
        spectrum: (R, C // 2 + 1) with C = R even and at least K.
        noise: N.
    """
    rows = spectrum.shape[-2]
    # The place of the origin changes the phase of all depths alike, and no error.
    transfer = torch.fft.rfft2(functions, s=(rows, rows))
    power = (transfer.real.square() + transfer.imag.square()).sum(-4)
    filters = spectrum * transfer.mean(-3, keepdim=True).conj()
    filters = filters / (spectrum * power.mean(-3, keepdim=True) + noise).unsqueeze(-4)
    residual = 1.0 - (filters * transfer).sum(-4)
    left = spectrum * (residual.real.square() + residual.imag.square())
    left = left + noise * (filters.real.square() + filters.imag.square()).sum(-4)
    own = spectrum * noise / (spectrum * power + noise)
    return LinearError(_mean(left, rows), _mean(own, rows))


def _mean(values: Tensor, columns: int) -> Tensor:
    """Average over all frequencies of a real image, of which the transform holds one half."""
    weight = half_spectrum_counts(columns, values)
    return (values * weight).sum((-2, -1)) / (values.shape[-2] * columns)
