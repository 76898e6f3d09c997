"""Probe images with the statistics of photographs, and the errors of renderers on them.

Photographs have power spectra that fall with the square of the frequency (Field, J. Opt. Soc. Am. A
4, 2379, 1987).  The error that a change of point spread function makes on such an image follows
from the change's spectrum alone; that of a whole renderer is measured against converged images by
rays.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

# Of photographs in linear light: the mean, and the standard deviation.
MEAN, CONTRAST = 0.4, 0.2
GREY_LEVEL = 1.0 / 255.0
# Texels around the sensor, for blur to draw from.
_MARGIN = 32
# The longest wave that is taken into account, texels.
_LONGEST = 256
# Windows of the reference along each side of a sensor, and pixels along each side of a window.
_WINDOWS, _SIDE = 3, 24


def probe_image(height: int, width: int, seed: int = 0) -> Tensor:
    """(1, 3, height, width), float64, linear light: 1/f noise, the same in no two colours.

    Values are kept within [0, 1], which touches one pixel in fifty.
    """
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(3, height, width, generator=generator, dtype=torch.float64)
    spectrum = torch.fft.rfft2(noise) / _frequency(height, width).clamp(min=1.0 / _LONGEST)
    spectrum[:, 0, 0] = 0.0
    image = torch.fft.irfft2(spectrum, s=(height, width))
    image = MEAN + CONTRAST * image / image.std(dim=(-2, -1), keepdim=True)
    return image.clamp(0.0, 1.0)[None]


def fine_detail(height: int, width: int, seed: int = 0) -> Tensor:
    """(1, 3, height, width), float64, linear light: squares of two texels, bright or dark.

    What photographs have at their sharpest edges, and textures all over: a third of its power lies
    beyond a quarter of the sampling frequency along rows or columns, where 1/f noise has little.
    """
    generator = torch.Generator().manual_seed(seed)
    squares = torch.rand(1, 3, -(-height // 2), -(-width // 2), generator=generator)
    signs = torch.where(squares < 0.5, -1.0, 1.0).double()
    image = MEAN + CONTRAST * signs.repeat_interleave(2, -2).repeat_interleave(2, -1)
    return image[..., :height, :width]


def probe_texture(
    sensor: Sensor, channels: int, seed: int, photographs: Tensor | None = None
) -> Tensor:
    """Probe images wider than a sensor all around, their colours in turn: one like a photograph,
    one of fine detail, and photographs that were given.

    Args:
        sensor: the pixels.
        channels: of the images.
        seed: of the two that are drawn.
        photographs: (P, 3, h, w), linear light in [0, 1]; larger ones are cropped to their middle,
            smaller ones repeat their edges.

    Returns:
        (2 + P, channels, H, W), float64.
    """
    size = (sensor.height + 2 * _MARGIN, sensor.width + 2 * _MARGIN)
    images = [probe_image(*size, seed), fine_detail(*size, seed)]
    if photographs is not None:
        images.append(_fitted(photographs.double().cpu(), size))
    return torch.cat(images)[:, [i % 3 for i in range(channels)]]


def _fitted(images: Tensor, size: tuple[int, int]) -> Tensor:
    """The middle of images (P, C, h, w), with edges repeated where they are too small."""
    for dim, wanted in ((-2, size[0]), (-1, size[1])):
        given = images.shape[dim]
        place = torch.arange(wanted) + (given - wanted) // 2
        images = images.index_select(dim, place.clamp(0, given - 1))
    return images


def probe_power(side: int) -> Tensor:
    """The probe's power at the frequencies of `rfft2`, (side, side/2 + 1), float64.

    Σ power · |H|² is the mean square of the image that a filter of transfer function H makes of it.
    """
    frequency = _frequency(side, side)
    power = 1.0 / frequency.clamp(min=1.0 / _LONGEST).square()
    # Frequencies with two signs stand for both of them.
    twice = torch.full((side // 2 + 1,), 2.0, dtype=torch.float64)
    twice[0] = 1.0
    if side % 2 == 0:
        twice[-1] = 1.0
    power = power * twice
    power[0, 0] = 0.0
    power = power * (CONTRAST**2 / power.sum())
    power[0, 0] = MEAN**2
    return power


def grey_levels(difference: Tensor) -> Tensor:
    """RMS error, in grey levels of 1/255, that differences of kernels make on the probe.

    Args:
        difference: (..., K, K).

    Returns:
        (...), float64: 255 · √(Σ power · |spectrum|²).
    """
    side = max(128, 2 * math.ceil(difference.shape[-1] / 2))
    spectrum = torch.fft.rfft2(difference.double(), s=(side, side))
    squared = spectrum.real.square() + spectrum.imag.square()
    power = probe_power(side).to(difference.device)
    return (squared * power).sum((-2, -1)).sqrt() / GREY_LEVEL


def blurred_grey_levels(kernels: Tensor, transfer: Tensor) -> Tensor:
    """RMS error, in grey levels, of leaving out a filter behind kernels.

    Args:
        kernels: (..., K, K).
        transfer: (side, side/2 + 1), the filter's transfer function at the frequencies of `rfft2`.
    """
    side = transfer.shape[0]
    spectrum = torch.fft.rfft2(kernels.double(), s=(side, side))
    squared = spectrum.real.square() + spectrum.imag.square()
    power = (probe_power(side) * (1.0 - transfer.cpu()).square()).to(kernels.device)
    return (squared * power).sum((-2, -1)).sqrt() / GREY_LEVEL


def _frequency(height: int, width: int) -> Tensor:
    """Cycles a texel at the frequencies of `rfft2`."""
    down = torch.fft.fftfreq(height, dtype=torch.float64)
    across = torch.fft.rfftfreq(width, dtype=torch.float64)
    return torch.hypot(down[:, None], across[None])


@dataclass(frozen=True)
class Reference:
    """Two renders of windows of a sensor, alike but for their samples.

    Attributes:
        windows: top row and left column of each, and its height and width.
        images: of each window, (2, B, D, C, height, width).
    """

    windows: tuple[tuple[int, int, int, int], ...]
    images: tuple[Tensor, ...]

    @property
    def noise(self) -> float:
        """RMS noise of the mean of both renders, grey levels; of the noisiest of the B images."""
        return float(self._noise().max())

    @property
    def uncertainty(self) -> float:
        """Grey levels below which an error is lost in that noise: the noise of its estimate."""
        values = sum(pair[0, 0].numel() for pair in self.images)
        return self.noise * (2.0 / values) ** 0.25

    def error(self, image: Tensor) -> float:
        """RMS error of images (B, D, C, height, width) of the sensor, without the noise of the
        reference, in grey levels; of the worst of them.
        """
        squares = []
        for (top, left, height, width), pair in zip(self.windows, self.images, strict=True):
            part = image[..., top : top + height, left : left + width].to(pair)
            squares.append((part - pair.mean(0)).square())
        remaining = _rms(squares).square() - self._noise().square()
        return math.sqrt(max(float(remaining.max()), 0.0))

    def _noise(self) -> Tensor:
        """(B,), of each image."""
        return _rms([(one - two).square() / 4.0 for one, two in self.images])


@torch.no_grad()
def reference(
    rays: RayRenderer,
    lens: Lens,
    scene: PlanarScene,
    texture: Tensor,
    seed: int,
    side: int = _SIDE,
) -> Reference:
    """Render a texture by rays on windows at a sensor's middle, edges and corners.

    Args:
        rays: for the whole sensor, with the samples of the pupil.
        lens: the lens.
        scene: planes and wavelengths.
        texture: (B, C, H, W), linear light.
        seed: of the rays.
        side: pixels along each side of a window.
    """
    sensor = rays.sensor
    height, width = min(side, sensor.height), min(side, sensor.width)
    rows, columns = (
        sorted({round(i * (side - part) / (_WINDOWS - 1)) for i in range(_WINDOWS)})
        for side, part in ((sensor.height, height), (sensor.width, width))
    )
    windows = tuple((top, left, height, width) for top in rows for left in columns)
    axial, images = rays.axial_pupil(lens, scene), []
    for window in windows:
        renderer = rays.on(sensor.window(*window))
        pair = [renderer.render(lens, scene, texture, 2 * seed + i, axial=axial) for i in range(2)]
        images.append(torch.stack(pair))
    return Reference(windows, tuple(images))


def _rms(squares: list[Tensor]) -> Tensor:
    """(B,), grey levels, from squares (B, ...) on several windows."""
    total = torch.stack([s.double().flatten(1).sum(1) for s in squares]).sum(0)
    return (total / sum(s[0].numel() for s in squares)).sqrt() / GREY_LEVEL


def rays_samples(
    lens: Lens, scene: PlanarScene, sensor: Sensor, texture: Tensor, tolerance: float
) -> tuple[int, float]:
    """Strata along each side of the pupil that `RayRenderer` needs, and the noise they leave.

    Noise falls at least with the root of the number of samples, so a coarse render tells.

    Returns:
        The strata, from 1 to 64, and the noise in grey levels.
    """
    coarse = 4
    found = reference(RayRenderer(sensor, coarse), lens, scene, texture, seed=7)
    # Of one render: √2 times that of the mean of two.
    noise = math.sqrt(2.0) * found.noise
    side = min(max(math.ceil(coarse * noise / tolerance), 1), 64)
    return side, noise * coarse / side
