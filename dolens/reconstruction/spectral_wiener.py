"""Spectra at every pixel are estimated from one image by the linear filter of least error.

The scene x is a stationary random field with L bands, x = G·z.  The columns of G (L, K) are
orthonormal spectra, and the K maps z are independent and have power spectra S_k(f).  Band λ is
blurred by its own function h_λ, a pixel behind the filter c takes the share T_cλ of it, and noise
of variance v_p is white.  At a frequency f of the pixels

    y_c(f) = Σ_k B_ck(f)·z_k(f),   B_ck = Σ_λ T_cλ·H_λ(f)·G_λk.

An array of filters repeats after P pixels, so that light of the P² frequencies f_a = f + a/P lands
on the same frequency of its P² phases p = (row, column), each an image of every P-th pixel:

    y_p(f) = 1/P² Σ_a exp(2πi f_a·p)·Σ_k B_c(p)k(f_a)·z_k(f_a) + n_p.

With A the matrix of these numbers, least error has ẑ = S·A*·(A·S·A* + v/P²)⁻¹·y: demosaicking,
deconvolution and spectra in one step (Wiener).  Light that a function loses beyond its window is
taken for an even veil over the image, so that H(0) = 1.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.reconstruction.wiener import close_periodically, padded_lengths
from dolens.sensor.colour import mosaic

# Frequencies that a power law is fitted to, cycles a pixel: below are slopes across the image,
# above are noise and interpolation of photographs.
_FITTED = 0.02, 0.35


class SpectralPrior(NamedTuple):
    """A prior knows of scenes what their second moments say.

    Attributes:
        spectra: G, (L, K), orthonormal.
        mean_square: (K,), of the maps' means over a scene.
        variance: (K,), of the maps about their means.
        exponent: (K,), β of S ∝ f^-β.
        mean: (L,), mean spectrum, for the shot noise.
        outside: (), variance of what G leaves out, mean over bands.
    """

    spectra: Tensor
    mean_square: Tensor
    variance: Tensor
    exponent: Tensor
    mean: Tensor
    outside: Tensor

    def power(self, rows: int, columns: int) -> Tensor:
        """Return S_k(f), (K, rows, columns): |z_k(f)|² of the discrete transform, in the mean, over
        the number of pixels.
        """
        square = _squared_frequencies(rows, columns, self.mean)
        square[0, 0] = 1.0
        found = square ** (-0.5 * self.exponent[:, None, None])
        found[:, 0, 0] = 0.0
        found = found * (self.variance[:, None, None] / found.mean((-2, -1), keepdim=True))
        found[:, 0, 0] = rows * columns * self.mean_square
        return found

    def to(self, device: torch.device) -> "SpectralPrior":
        """Return the same prior on another device."""
        return SpectralPrior(*(tensor.to(device) for tensor in self))


def spectral_prior(scenes: Tensor, count: int) -> SpectralPrior:
    """Fit a prior to scenes.

    G has the principal spectra of the second moment, not centred; each map's variance is its own,
    and its exponent the slope of its periodogram, weighted by a Hann window, in logarithms.

    Args:
        scenes: (N, L, H, W), N at least 1.
        count: K, at most L.
    """
    scenes = scenes.double()
    bands = scenes.shape[1]
    pixels = scenes.movedim(1, -1).reshape(-1, bands)
    values, vectors = torch.linalg.eigh(pixels.mT @ pixels / len(pixels))
    spectra = vectors[:, -count:].flip(1)
    maps = torch.einsum("nlhw,lk->nkhw", scenes, spectra)
    means = maps.mean((-2, -1))
    centred = maps - means[..., None, None]
    rows, columns = maps.shape[-2:]
    window = torch.hann_window(rows, dtype=maps.dtype)[:, None]
    window = window * torch.hann_window(columns, dtype=maps.dtype)
    power = torch.fft.fft2(centred * window).abs().square().mean(0)
    frequency = _squared_frequencies(rows, columns, maps).sqrt()
    fitted = (frequency > _FITTED[0]) & (frequency < _FITTED[1])
    at = frequency[fitted].log()
    at = at - at.mean()
    # Each octave has the same weight, however many frequencies there are in it.
    weight = frequency[fitted] ** -2
    at = at - (weight * at).sum() / weight.sum()
    slope = (weight * at * power[:, fitted].log()).sum(-1) / (weight * at * at).sum()
    return SpectralPrior(
        spectra,
        means.square().mean(0),
        centred.square().mean((0, 2, 3)),
        (-slope).clamp(0.5, 4.0),
        pixels.mean(0),
        values[: bands - count].clamp(min=0.0).sum() / bands,
    )


@dataclass(frozen=True)
class SpectralCamera:
    """A camera that blurs each band by its own function.

    Attributes:
        functions: h, (L, K, K), K odd, upright; sums are shares of light, at most about 1.
        responses: T, (C, L): C = 1, or red, green and blue; shares of the signal of white.
        pattern: of Bayer's filters, as `RGGB`; None where C = 1.
        noise: a and b, variance a·s + b of a signal s, as `Readout.noise`.
    """

    functions: Tensor
    responses: Tensor
    pattern: str | None
    noise: tuple[float, float]

    @property
    def period(self) -> int:
        """P, pixels."""
        return 1 if self.pattern is None else 2

    @property
    def filters(self) -> Tensor:
        """Return which response each phase has, (P²,), row by row."""
        if self.pattern is None:
            return torch.zeros(1, dtype=torch.long)
        colours = torch.arange(3.0).reshape(3, 1, 1).expand(3, 2, 2)
        return mosaic(colours, self.pattern).flatten().long()

    def transfer(self, rows: int, columns: int) -> Tensor:
        """Return H_λ(f), (L, rows, columns)."""
        size = self.functions.shape[-1]
        padded = torch.nn.functional.pad(self.functions, (0, columns - size, 0, rows - size))
        found = torch.fft.fft2(padded.double().roll((-(size // 2), -(size // 2)), (-2, -1)))
        veil = torch.zeros_like(found)
        veil[:, 0, 0] = 1.0 - found[:, 0, 0]
        return found + veil

    def image(self, scene: Tensor) -> Tensor:
        """Return the signal before noise.

        Args:
            scene: (N, L, H, W).

        Returns:
            (N, C, H - K + 1, W - K + 1): every filter at every pixel, of pixels whose light is all
            in the scene.
        """
        margin = self.functions.shape[-1] // 2
        height, width = scene.shape[-2:]
        transfer = self.transfer(height, width).to(torch.complex64)
        spectrum = torch.fft.fft2(scene) * transfer
        found = torch.einsum("cl,nlhw->nchw", self.responses.to(spectrum), spectrum)
        image = torch.fft.ifft2(found).real
        return image[..., margin : height - margin, margin : width - margin]


class SpectralWiener:
    """The estimator of a camera and a prior; differentiable in the camera's functions.

    Attributes:
        expected_error: mean squared error of a pixel and band that the prior expects.

    Args:
        camera: the camera.
        prior: of scenes.
        shape: height and width of the images, multiples of P.
        margin: pixels that bridge opposite edges; None: as many as half a function has.
    """

    def __init__(
        self,
        camera: SpectralCamera,
        prior: SpectralPrior,
        shape: tuple[int, int],
        margin: int | None = None,
    ) -> None:
        size, period = camera.functions.shape[-1], camera.period
        self.camera, self.prior, self.shape = camera, prior, shape
        margin = size // 2 if margin is None else margin
        parts = shape[0] // period, shape[1] // period
        self.coarse = rows, columns = padded_lengths(*parts, -(-margin // period), 1)
        fine = period * rows, period * columns
        # Noise is a billionth of the power at f = 0.
        dtype, device = torch.float64, camera.functions.device
        spectra, responses = prior.spectra.to(dtype), camera.responses.to(dtype)
        mixed = torch.einsum("cl,lk->ckl", responses, spectra).to(dtype.to_complex())
        through = torch.einsum("ckl,lhw->ckhw", mixed, camera.transfer(*fine))
        # The fine frequency f_a of a coarse one: a-th part of each axis.
        power = self._parts(prior.power(*fine).to(dtype))
        filters, steps = camera.filters, torch.arange(period, dtype=dtype, device=device)
        phases = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
        rates = [torch.fft.fftfreq(n, dtype=dtype, device=device) for n in fine]
        turns = phases[:, 0, None, None] * rates[0][:, None] + phases[:, 1, None, None] * rates[1]
        turned = torch.exp(2j * math.pi * turns)[:, None] * through[filters] / period**2
        # (row, column, phase, part and map)
        matrix = self._parts(turned).movedim((0, 1, 2), (2, 3, 4)).flatten(3)
        signal = power.movedim((0, 1), (2, 3)).flatten(2)
        a, b = camera.noise
        light = (responses @ prior.mean.to(dtype))[filters]
        noise = (a * light + b) / period**2
        gain = signal[..., None] * matrix.mH
        covariance = matrix @ gain + torch.diag(noise).to(matrix)
        # (row, column, part and map, phase)
        self.filter = torch.linalg.solve(covariance, gain, left=False)
        kept = (self.filter * matrix.mT).sum(-1).real
        left = (signal * (1.0 - kept)).mean() * (len(prior.variance) / len(prior.mean))
        self.expected_error = left + prior.outside

    def _parts(self, values: Tensor) -> Tensor:
        """Map (..., K, P·R, P·C) to (..., P², K, R, C)."""
        rows, columns = self.coarse
        period = self.camera.period
        split = values.unflatten(-1, (period, columns)).unflatten(-3, (period, rows))
        # (..., K, P, R, P, C) → (..., P, P, K, R, C)
        return split.movedim((-4, -2), (-5, -4)).flatten(-5, -4)

    def __call__(self, raw: Tensor) -> Tensor:
        """Estimate spectra.

        Args:
            raw: (N, 1, H, W), the image behind its filters, over the signal of white.

        Returns:
            (N, L, H, W).
        """
        period, (rows, columns) = self.camera.period, self.coarse
        phases = torch.nn.functional.pixel_unshuffle(raw, period)
        spectrum = torch.fft.fft2(close_periodically(phases, rows, columns))
        found = torch.einsum("hwkp,nphw->nkhw", self.filter.to(spectrum), spectrum)
        found = found.unflatten(1, (period, period, -1)).permute(0, 3, 1, 4, 2, 5)
        maps = torch.fft.ifft2(found.flatten(4).flatten(2, 3)).real
        maps = maps[..., : self.shape[0], : self.shape[1]]
        return torch.einsum("lk,nkhw->nlhw", self.prior.spectra.to(maps), maps)


def _squared_frequencies(rows: int, columns: int, like: Tensor) -> Tensor:
    """Return f², (rows, columns), cycles a pixel."""
    options = {"dtype": like.dtype, "device": like.device}
    down, across = (torch.fft.fftfreq(n, **options) for n in (rows, columns))
    return down[:, None].square() + across.square()
