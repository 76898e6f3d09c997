"""Restorers that nothing has trained: Wiener's deconvolution, and a classic of denoising behind it.

Every trained network is to be compared with them.  The deconvolution leaves noise whose strength
follows the light and whose spectrum is the filter's.  `VarianceStabiliser` makes it even, so that
one strength of denoising suits dark and bright parts.

Noise whose variance grows with the light is made even, and denoised means are undone without
bias.

A sensor's noise has variance a·x + b at light x: shot noise and read noise.  A function f whose
slope is one over the noise's standard deviation makes it 1 everywhere (Starck, Murtagh and Bijaoui,
Image Processing and Data Analysis, 1998):

    f(z) = 2/a · √(max(a·z + b, 0) + 3a²/8).

Denoising gives an estimate of the mean of f(z), which is not f of the mean.  Its inverse is that of
x ↦ E f(z) (Mäkitalo and Foi, IEEE Trans. Image Process. 22, 91, 2013), here of Gaussian noise, as
the noise of a filtered image nearly is.
"""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dolens.errors import InputError
from dolens.reconstruction.opponent_wiener import (
    checked_ratios,
    colour_filters,
    correlations,
    functions_of_each,
)
from dolens.reconstruction.restoration import Restoration
from dolens.reconstruction.wiener import LEAST_SHOT, close_periodically, padded_lengths, readouts_of
from dolens.sensor.colour import linear_to_srgb

Array = NDArray[np.float64]

# The noise's variance that ratios are stated for: 100 electrons in white and a read noise of 3, at
# a quarter of white, near the mean of photographs.
REFERENCE_VARIANCE = 0.25 / 100.0 + (3.0 / 100.0) ** 2


class UntrainedRestoration(Restoration):
    """Restore by a Wiener filter in opponent colours and a denoiser behind it.

    Pixels are added at each edge for half of the point spread functions; see `wiener_deconvolve`.
    Where the depth is unknown the filter is that of least mean error over the depths; see
    `solve_in_opponent_colours`.  There is nothing to train, and no gradient passes.

    Args:
        noise_to_signal: r of luminance and of both differences of colours, noise over signal power
            at the Nyquist frequency where the noise's variance is `REFERENCE_VARIANCE`; it grows
            with the variance.  Less than would be best for the filter alone: what noise that lets
            through, the denoiser takes.

    Raises:
        InputError: numbers out of range.
    """

    needs_point_spread_function: ClassVar[bool] = True
    needs_noise: ClassVar[bool] = True
    takes_functions_of_images: ClassVar[bool] = True
    takes_readouts: ClassVar[bool] = True

    def __init__(self, noise_to_signal: Sequence[float]) -> None:
        super().__init__()
        self.ratios: Tensor
        self.register_buffer("ratios", checked_ratios(noise_to_signal), persistent=False)

    @abstractmethod
    def denoised(self, image: Array, spectrum: Array) -> Array:
        """Return an image (H, W, 3) without its noise of unit variance.

        Args:
            image: with the noise.
            spectrum: the noise's power by `numpy.fft.fft2`'s frequencies, (H, W, 3), of mean 1.
        """

    @torch.no_grad()
    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `point_spread_functions` or `noise` is None, or of another shape.
        """
        functions, noise = self.functions_and_noise(point_spread_functions, noise)
        raw = raw.to(self.dtype)
        pairs = zip(raw, functions_of_each(raw, functions.to(raw)), strict=True)
        return torch.stack([self._restored(image, own, noise) for image, own in pairs])

    def _restored(self, raw: Tensor, functions: Tensor, noise: Tensor) -> Tensor:
        readouts = readouts_of(raw[None], functions, noise)
        shot, read = (float(value) for value in readouts.noise)
        shot = max(shot, LEAST_SHOT)
        height, width = raw.shape[-2:]
        light = float(readouts.mean.mean().clamp(min=0.0))
        ratio = (shot * light + read) / REFERENCE_VARIANCE
        size = functions.shape[-1]
        rows, columns = padded_lengths(height, width, size // 2, size)
        matched, power = correlations(readouts.functions, rows, columns)
        power = power.sum(dim=0, keepdim=True).expand_as(power)
        filters = colour_filters(power, matched, ratio * self.ratios[None], columns)
        spectrum = torch.fft.rfft2(close_periodically(readouts.images[0], rows, columns))
        found = torch.einsum("ncduv,nduv->cuv", filters, spectrum)
        image = torch.fft.irfft2(found, s=(rows, columns))[..., :height, :width]
        power = noise_power(filters.transpose(0, 1).flatten(1, 2), columns)
        stabiliser = VarianceStabiliser.of_filtered(shot, read, power.mean(dim=(-2, -1)))
        even = stabiliser.stabilised(image).permute(1, 2, 0).double().cpu().numpy()
        colour = resampled_spectrum(power, height, width)
        clean = torch.from_numpy(np.ascontiguousarray(self.denoised(even, colour))).to(image)
        return linear_to_srgb(stabiliser.undone(clean.permute(2, 0, 1)))


def noise_power(filters: Tensor, columns: int) -> Tensor:
    """Return the power of each colour's noise behind filters, of white noise of variance 1.

    Args:
        filters: to a colour from a colour, on the grid of `torch.fft.rfft2`, (3, 3, R, C // 2 + 1),
            or from those of several readouts, (3, 3·N, R, C // 2 + 1).
        columns: C.

    Returns:
        (3, R, C), whose mean over the frequencies is the variance.
    """
    half = (filters.real**2 + filters.imag**2).sum(dim=1)
    rows = torch.arange(half.shape[-2], device=half.device)
    # A real filter has the same power at a frequency and at its opposite.
    opposite = half[:, -rows % len(rows)][..., 1 : (columns + 1) // 2].flip(-1)
    return torch.cat([half, opposite], dim=-1)


def resampled_spectrum(power: Tensor, height: int, width: int) -> Array:
    """Return a spectrum (3, R, C) at the frequencies of another size, of mean 1, (H, W, 3).

    The noise's correlation is cut at half the image: what reaches farther cannot be told apart in
    it.
    """
    correlation = torch.fft.ifft2(power.double()).real
    for dimension, size in ((-2, height), (-1, width)):
        shifts = torch.fft.fftfreq(size, 1.0 / size, device=power.device).round().long()
        correlation = correlation.index_select(dimension, shifts.remainder(power.shape[dimension]))
    spectrum = torch.fft.fft2(correlation).real.clamp(min=0.0)
    spectrum = spectrum / spectrum.mean(dim=(-2, -1), keepdim=True)
    return spectrum.permute(1, 2, 0).cpu().numpy()


class WienerTVRestoration(UntrainedRestoration):
    """Restore by Wiener's filter and total variation (Rudin, Osher and Fatemi, Physica D 60, 259).

    It minimises ½‖u - image‖² + weight·TV(u) over all colours at once (Chambolle, J. Math. Imaging
    Vis. 20, 89), by scikit-image.

    Args:
        noise_to_signal: see `UntrainedRestoration`.
        weight: of the total variation, in the noise's standard deviations.
    """

    def __init__(
        self,
        noise_to_signal: Sequence[float] = (0.3, 2.1, 6.0),
        weight: float = 2.0,
    ) -> None:
        super().__init__(noise_to_signal)
        if not weight > 0.0:
            raise InputError(f"weight={weight}: must be positive")
        self.weight = weight

    def denoised(self, image: Array, spectrum: Array) -> Array:
        """Return the image of least variation near this one; the spectrum is not looked at."""
        from skimage.restoration import denoise_tv_chambolle

        return denoise_tv_chambolle(image, self.weight, eps=1e-5, max_num_iter=200, channel_axis=-1)


class WienerBM3DRestoration(UntrainedRestoration):
    """Restore by Wiener's filter and block matching (Dabov et al., IEEE Trans. Image Process. 16,
    2080), which knows the spectrum of the noise (Mäkinen, Azzari and Foi, ibid. 29, 8339).

    By its authors' package `bm3d`, which is free for other than commercial use alone.

    Args:
        noise_to_signal: see `UntrainedRestoration`.
        strength: factor on the noise's variance.

    Raises:
        InputError: the package is missing.
    """

    def __init__(
        self,
        noise_to_signal: Sequence[float] = (0.3, 2.1, 6.0),
        strength: float = 3.0,
    ) -> None:
        super().__init__(noise_to_signal)
        if not strength > 0.0:
            raise InputError(f"strength={strength}: must be positive")
        self.strength = strength
        if not bm3d_is_installed():
            raise InputError(
                "network=wiener_bm3d needs the package bm3d: pip install dolens[bm3d] (its licence "
                "allows other than commercial use alone)"
            )

    def denoised(self, image: Array, spectrum: Array) -> Array:
        """Return the image without noise of this spectrum."""
        with _numpy_of_bm4d():
            from bm3d import bm3d_rgb

            return bm3d_rgb(image, self.strength * image[..., 0].size * spectrum)


def bm3d_is_installed() -> bool:
    """Return whether the package `bm3d` is there."""
    return find_spec("bm3d") is not None


@contextmanager
def _numpy_of_bm4d() -> Iterator[None]:
    """Give NumPy the old name of `trapezoid` within, which bm4d 4.2.5 calls and NumPy 2.4 lacks."""
    if hasattr(np, "trapz"):
        yield
        return
    setattr(np, "trapz", np.trapezoid)  # noqa: B010
    try:
        yield
    finally:
        delattr(np, "trapz")


# Points of the table of E f, evenly spaced in √x, and of the quadrature over the noise.
_POINTS, _NODES = 1024, 48


class VarianceStabiliser(NamedTuple):
    """Makes noise of variance slope·x + offset one of variance 1, and back.

    Attributes:
        slope: a > 0, of each of C colours, (C,).
        offset: b ≥ 0, (C,).
    """

    slope: Tensor
    offset: Tensor

    @classmethod
    def of_filtered(cls, shot: float, read: float, gain: Tensor) -> Self:
        """Return that of an image that a linear filter has made of a sensor's.

        Light is taken for alike over the reach of the filter and over the colours.

        Args:
            shot: variance of the sensor's noise for each unit of light; above 0.
            read: variance in the dark.
            gain: variance of each colour where the sensor's noise has variance 1, (C,): Σ |w|² of
                the filter's weights.
        """
        gain = gain.double()
        return cls(gain * shot, gain * read)

    def stabilised(self, light: Tensor) -> Tensor:
        """Return f of images (..., C, H, W), in their dtype."""
        slope, offset = (v.to(light)[:, None, None] for v in self)
        root = ((slope * light + offset).clamp(min=0.0) + 0.375 * slope**2).sqrt()
        return 2.0 / slope * root

    def undone(self, values: Tensor) -> Tensor:
        """Return the light x whose E f(z) is given, (..., C, H, W), at least 0."""
        colours = [
            _interpolated(values[..., number, :, :], slope, offset)
            for number, (slope, offset) in enumerate(
                zip(self.slope.tolist(), self.offset.tolist(), strict=True)
            )
        ]
        return torch.stack(colours, dim=-3)


def _interpolated(values: Tensor, slope: float, offset: float) -> Tensor:
    """Return x of E f(z) by a table, whose end lies beyond the largest value."""
    largest = float(values.max())
    # f grows as √x, and its mean lies below it by less than 1.
    end = max((0.5 * slope * (largest + 1.0)) ** 2 / slope, 10.0 * slope)
    light = np.linspace(0.0, np.sqrt(end), _POINTS) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    noisy = light[:, None] + np.sqrt(slope * light + offset)[:, None] * nodes
    root = np.sqrt(np.maximum(slope * noisy + offset, 0.0) + 0.375 * slope**2)
    means = 2.0 / slope * root @ (weights / weights.sum())
    found = np.interp(values.double().cpu().numpy(), means, light)
    return torch.from_numpy(found).to(values)
