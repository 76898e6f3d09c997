"""Bright lights in and about the pictures of a camera: it meets ghosts and veiling light."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.stray_light import Light, light_on_sensor, veil
from dolens.scene.planar import as_planes
from dolens.scene.scene import Scene
from dolens.sensor.noise import BatchShare, generator_of
from dolens.sensor.pixels import Sensor

_MOST = 100


class RandomLights:
    """Lights of random places and powers are added to images, with ghosts and veil.

    Places are even over the sensor and what lies around it; powers are even in their logarithm, and
    white.  Images are differentiable in the lens and its coatings.  Where lights stand in front of
    the lens, and what is white, is that of the lens as it begins: it is held in value and
    derivative.  A light's own image is that of its rays; in the truth it is a white pixel.

    Args:
        count: of lights at each picture.
        power: least and largest, white pixels.
        beyond: of the sensor's sides, how far around it lights stand.
        rays: of each light, path and colour, and of each of the veil's four fields.
        veiled: whether the picture's own ghosts are added as a veil.
        sensor_reflectance: share of the light that the sensor reflects.

    Raises:
        InputError: a number out of range.
    """

    def __init__(
        self,
        count: int = 1,
        power: Sequence[float] = (1e3, 1e5),
        beyond: float = 0.25,
        rays: int = 500,
        veiled: bool = True,
        sensor_reflectance: float = 0.0,
    ) -> None:
        if count not in range(1, _MOST + 1):
            raise InputError(f"views.lights.count: {count}; allowed: 1 to {_MOST}")
        numbers = all(isinstance(value, int | float) for value in power)
        if not numbers or len(power) != 2 or not 0.0 < power[0] <= power[1] < math.inf:
            raise InputError(f"views.lights.power: {list(power)}; allowed: 0 < least <= largest")
        if not 0.0 <= beyond < math.inf:
            raise InputError(f"views.lights.beyond: {beyond}; allowed: 0 or more")
        if not 0.0 <= sensor_reflectance <= 1.0:
            raise InputError(
                f"views.lights.sensor_reflectance: {sensor_reflectance}; allowed: 0 to 1"
            )
        self.count, self.power, self.beyond = count, (power[0], power[1]), beyond
        self.rays, self.veiled, self.sensor_reflectance = rays, veiled, sensor_reflectance
        self._imaging: ImagingSystem | None = None

    @torch.no_grad()
    def begin(self, lens: Lens, scene: Scene, sensor: Sensor) -> None:
        """Hold where lights stand, and what is white, as they are for this lens.

        Raises:
            InputError: no light reaches the sensor's centre.
        """
        system = lens.system().double()
        planes = replace(as_planes(scene), texture_scale="fixed").fixed_for(system)
        self._imaging = ImagingSystem.of(system, planes, sensor)

    def drawn(self, sensor: Sensor, generator: torch.Generator) -> list[Light]:
        """Draw the lights of a picture."""
        row, column, power = torch.rand(3, self.count, generator=generator, dtype=torch.float64)
        down, across = (
            (1.0 + 2.0 * self.beyond) * (share - 0.5) * side + 0.5 * (side - 1)
            for share, side in ((row, sensor.height), (column, sensor.width))
        )
        least, largest = self.power
        white = least * (largest / least) ** power
        return [
            Light(r, c, (p, p, p))
            for r, c, p in zip(down.tolist(), across.tolist(), white.tolist(), strict=True)
        ]

    def added_to(
        self, lens: Lens, image: Tensor, truth: Tensor, seed: int, share: BatchShare | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return images and truths with lights.

        Args:
            lens: as it is now; `begin` has seen the first.
            image: (B, D, 3, H, W), linear light.
            truth: likewise, display-encoded.
            seed: of places and powers.
            share: of a larger batch, whose random numbers these pictures have their part of.
        """
        imaging = self._imaging
        assert imaging is not None  # `begin` comes first
        generator = generator_of(seed)
        first = 0 if share is None else share.first
        pictures = [self.drawn(imaging.sensor, generator) for _ in range(first + len(image))][
            first:
        ]
        if self.veiled:
            veils = torch.stack(
                [
                    veil(lens, imaging, d, self.sensor_reflectance, rays=self.rays)
                    for d in range(image.shape[1])
                ]
            )
            means = image.mean((-2, -1), keepdim=True)
            image = image + veils.to(image)[..., None, None] * means
        added = [
            torch.stack(
                [
                    light_on_sensor(
                        lens, imaging, d, lights, self.rays, self.sensor_reflectance, False
                    )
                    for d in range(image.shape[1])
                ]
            )
            for lights in pictures
        ]
        mask = torch.stack([_pixels_of(lights, imaging.sensor) for lights in pictures])
        truth = torch.where(mask.to(truth.device)[:, None, None], 1.0, truth)
        return image + torch.stack(added).to(image), truth


def _pixels_of(lights: Sequence[Light], sensor: Sensor) -> Tensor:
    """Return the pixels (H, W) that lights lie in."""
    found = torch.zeros(sensor.height, sensor.width, dtype=torch.bool)
    for light in lights:
        row, column = round(light.row), round(light.column)
        if 0 <= row < sensor.height and 0 <= column < sensor.width:
            found[row, column] = True
    return found
