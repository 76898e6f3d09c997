"""A lens's blur of planes, one kernel a plane and field."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patch_convolution import convolve_patches
from dolens.rendering.patches import Coordinates, PatchLayout
from dolens.scene.scene import texture_origin


@dataclass(frozen=True)
class PlaneBlur:
    """Convolution of planes with a lens's kernels, a scene's `Blur`.

    Attributes:
        kernels: (N, D or 1, C or 1, K, K), differentiable.
        layout: N patches, and the object points of their pixels.
        illumination: (C or 1, height, width), what the image of every plane is multiplied by; or
            None.
    """

    kernels: Tensor
    layout: PatchLayout
    illumination: Tensor | None = None

    def __call__(self, maps: Tensor) -> Tensor:
        """(B, D, C, height, width) of maps (B, D or 1, C or 1, H, W)."""
        image = convolve_patches(maps, self.kernels, self.layout)
        return image if self.illumination is None else image * self.illumination

    def white(self) -> Tensor:
        """Return the blurred maps of ones, (D or 1, C or 1, height, width)."""
        image = uniform_image(self.kernels, self.layout)
        return image if self.illumination is None else image * self.illumination

    def illuminated(self, light: Tensor, wanted: Tensor) -> "PlaneBlur":
        """The same with kernels of unit light, and a relative illumination found otherwise.

        Pixels whose kernels are partly dark get their light from the others.

        Args:
            light: (N, C or 1), of each node's kernels.
            wanted: (C or 1, height, width), of each pixel.
        """
        bright = light.detach() > 0.0
        light = torch.where(bright, light, 1.0)
        covered, lit = torch.zeros_like(wanted), []
        for patch, some in zip(self.layout.patches, bright[..., None, None], strict=True):
            share = torch.where(some, patch.weight, 0.0)
            covered[:, patch.top : patch.bottom, patch.left : patch.right] += share
            lit.append(patch._replace(weight=share))
        scale = wanted / torch.where(covered > 0.0, covered, 1.0)
        kernels = self.kernels / light[:, None, :, None, None]
        return PlaneBlur(kernels, replace(self.layout, patches=lit), scale)


def places_in_texture(
    imaging: ImagingSystem, size: tuple[int, int], object_points: tuple[Tensor, Tensor] | None
) -> tuple[tuple[int, int], Coordinates | None]:
    """Find the object points of a sensor's pixels in a texture.

    Args:
        imaging: the sensor, and the scene that says where the texture's centre lies.
        size: height and width of the texture.
        object_points: rows and columns where the pixels' chief rays meet the planes, each
            (D, C, height, width); None: where a pinhole sees them.

    Returns:
        Row and column of the object point of pixel (0, 0), where the others follow texel by texel,
        and None; else (0, 0) and the coordinates of all pixels.
    """
    scene, sensor = imaging.scene, imaging.sensor
    row, column = texture_origin(size, scene.texture_centre)
    if object_points is not None:
        down, across = object_points
        return (0, 0), Coordinates(down + row, across + column)
    top = row - (0.5 * (sensor.height - 1) - sensor.centre_row)
    left = column - (0.5 * (sensor.width - 1) - sensor.centre_column)
    if top.is_integer() and left.is_integer():
        return (int(top), int(left)), None
    options: dict[str, Any] = {"dtype": torch.float64, "device": imaging.system.device}
    rows, columns = torch.meshgrid(
        torch.arange(sensor.height, **options),
        torch.arange(sensor.width, **options),
        indexing="ij",
    )
    shape = (len(scene.depths), len(scene.wavelengths), sensor.height, sensor.width)
    return (0, 0), Coordinates((rows + top).expand(shape), (columns + left).expand(shape))


def uniform_image(kernels: Tensor, layout: PatchLayout) -> Tensor:
    """Compute what `convolve_patches` makes of ones: Σ over nodes of weight · Σ kernel.

    Args:
        kernels: (N, D or 1, C or 1, K, K).
        layout: N patches, all with or all without weights for each channel.

    Returns:
        (D or 1, C or 1, height, width).
    """
    sums = kernels.sum((-2, -1))[..., None, None]
    channels = max(
        [sums.shape[2], *(p.weight.shape[0] for p in layout.patches if p.weight.dim() > 2)]
    )
    image = sums.new_zeros((sums.shape[1], channels, *layout.image_size))
    for total, patch in zip(sums, layout.patches, strict=True):
        image[..., patch.top : patch.bottom, patch.left : patch.right] += patch.weight * total
    return image
