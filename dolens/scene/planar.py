"""Scenes of textured planes that make an image each, and what an ideal pinhole sees of them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.scene.scene import Blur, Scene, bilinear
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class PlanarScene(Scene):
    """A textured plane at one of several depths: an image for each of them.

    Textures are (B, C, H, W), linear light, a channel for each wavelength.
    """

    separate_planes: ClassVar[bool] = True

    def labels(self) -> list[str]:
        """The depths, as metrics name them."""
        return self.plane_labels()

    def colours(self, textures: Tensor) -> Tensor:
        """The textures as they are."""
        return textures

    def on_planes(self, textures: Tensor) -> tuple[Tensor, ...]:
        """The textures, one for all planes: (B, 1, C, H, W)."""
        if textures.dim() != 4 or textures.shape[1] != len(self.wavelengths):
            raise InputError(
                f"textures must be (B, {len(self.wavelengths)}, H, W), one channel a wavelength, "
                f"not {tuple(textures.shape)}"
            )
        return (textures[:, None],)

    def gather(
        self,
        shown: tuple[Tensor, ...],
        channel: int,
        places: Iterable[tuple[Tensor, Tensor]],
        weight: Tensor,
    ) -> Tensor:
        """The weighted sum over each pixel's rays, (B, D, P); see `Scene.gather`."""
        (textures,) = shown
        sums = [
            (bilinear(textures[:, 0, channel], rows, columns) * weight).sum(dim=-1)
            for rows, columns in places
        ]
        return torch.stack(sums, dim=1)

    def blend(self, shown: tuple[Tensor, ...], blur: Blur) -> Tensor:
        """Each blurred plane is an image, (B, D, C, height, width); see `Scene.blend`."""
        (textures,) = shown
        return blur(textures).expand(-1, len(self.depths), -1, -1, -1)


def as_planes(
    scene: Scene,
    depths: tuple[float, ...] | None = None,
    wavelengths: tuple[float, ...] | None = None,
    texture_centre: tuple[float, float] | None = None,
) -> PlanarScene:
    """Return planes that make images of their own, of a scene's scale: its own planes, or others.

    Args:
        scene: the scene, of any kind.
        depths: mm in front of the first vertex, instead of the scene's.
        wavelengths: nm, instead of the scene's.
        texture_centre: rows and columns, as of `Scene`, instead of the scene's.
    """
    return PlanarScene(
        scene.depths if depths is None else depths,
        scene.wavelengths if wavelengths is None else wavelengths,
        scene.texture_centre if texture_centre is None else texture_centre,
        texture_scale=scene.texture_scale,
        fixed_scales=scene.fixed_scales,
    )


def pinhole_image(
    textures: Tensor, sensor: Sensor, texture_centre: tuple[float, float] = (0.0, 0.0)
) -> Tensor:
    """Return what a distortion-free pinhole of the lens's magnification sees: the ground truth.

    Args:
        textures: (..., H, W), as `Scene` maps them.
        sensor: its pixels; where H - height is odd, pixel centres fall between texels.
        texture_centre: of `Scene`.

    Returns:
        (..., height, width): the textures' values at the pixel centres.
    """
    height, width = textures.shape[-2:]
    top = (height - sensor.height) / 2.0 + (sensor.centre_row - texture_centre[0])
    left = (width - sensor.width) / 2.0 + (sensor.centre_column - texture_centre[1])
    inside = 0 <= top <= height - sensor.height and 0 <= left <= width - sensor.width
    if inside and top.is_integer() and left.is_integer():
        top, left = int(top), int(left)
        return textures[..., top : top + sensor.height, left : left + sensor.width]
    options: dict[str, Any] = {"dtype": textures.dtype, "device": textures.device}
    rows = torch.arange(sensor.height, **options) + top
    columns = torch.arange(sensor.width, **options) + left
    grid = torch.meshgrid(rows, columns, indexing="ij")
    image = bilinear(textures.reshape(-1, height, width), *grid)
    return image.reshape(*textures.shape[:-2], sensor.height, sensor.width)
