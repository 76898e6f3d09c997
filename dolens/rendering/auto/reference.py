"""The converged images of probes by rays, on some windows of the sensor, and errors against it."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.auto.probe import GREY_LEVEL
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

_WINDOWS, _SIDE = 3, 24


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
    lens: Lens,
    scene: PlanarScene,
    sensor: Sensor,
    texture: Tensor,
    pupil_samples: int,
    seed: int,
    side: int = _SIDE,
) -> Reference:
    """Render a texture by rays on windows, `side` pixels wide, at the sensor's middle, edges and
    corners.
    """
    height, width = min(side, sensor.height), min(side, sensor.width)
    rows, columns = (
        sorted({round(i * (side - part) / (_WINDOWS - 1)) for i in range(_WINDOWS)})
        for side, part in ((sensor.height, height), (sensor.width, width))
    )
    windows = tuple((top, left, height, width) for top in rows for left in columns)
    axial, images = RayRenderer(sensor, pupil_samples).axial_pupil(lens, scene), []
    for window in windows:
        renderer = RayRenderer(sensor.window(*window), pupil_samples)
        pair = [renderer.render(lens, scene, texture, 2 * seed + i, axial=axial) for i in range(2)]
        images.append(torch.stack(pair))
    return Reference(windows, tuple(images))


def _rms(squares: list[Tensor]) -> Tensor:
    """(B,), grey levels, from squares (B, ...) on several windows."""
    total = sum(s.double().flatten(1).sum(1) for s in squares)
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
    found = reference(lens, scene, sensor, texture, coarse, seed=7)
    # Of one render: √2 times that of the mean of two.
    noise = math.sqrt(2.0) * found.noise
    side = min(max(math.ceil(coarse * noise / tolerance), 1), 64)
    return side, noise * coarse / side
