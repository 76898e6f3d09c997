"""A lens's blur of planes, one kernel a plane and field."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dolens.rendering.patch_convolution import Coordinates, Patch, convolve_patches


@dataclass(frozen=True)
class PlaneBlur:
    """Convolution of planes with a lens's kernels, a scene's `Blur`.

    Attributes:
        kernels: (N, D or 1, C or 1, K, K), differentiable.
        layout: N patches.
        origin: row and column of the texture that pixel (0, 0) looks at.
        image_size: height and width.
        coordinates: where the pixels look, if that is not simply every pixel a texel further.
        fused: whether the CPU's kernels look up.
        illumination: (C or 1, height, width), what the image of every plane is multiplied by; or
            None.
    """

    kernels: Tensor
    layout: Sequence[Patch]
    origin: tuple[int, int]
    image_size: tuple[int, int]
    coordinates: Coordinates | None
    fused: bool
    illumination: Tensor | None = None

    def __call__(self, maps: Tensor) -> Tensor:
        """(B, D, C, height, width) of maps (B, D or 1, C or 1, H, W)."""
        image = convolve_patches(
            maps,
            self.kernels,
            self.layout,
            self.origin,
            self.image_size,
            self.coordinates,
            self.fused,
        )
        return image if self.illumination is None else image * self.illumination

    def white(self) -> Tensor:
        """What maps of ones become, (D or 1, C or 1, height, width)."""
        image = uniform_image(self.kernels, self.layout, self.image_size)
        return image if self.illumination is None else image * self.illumination


def uniform_image(kernels: Tensor, layout: Sequence[Patch], image_size: tuple[int, int]) -> Tensor:
    """What `convolve_patches` makes of a texture of ones: Σ over nodes of weight · Σ kernel.

    Args:
        kernels: (N, D or 1, C or 1, K, K).
        layout: N patches, all with or all without weights for each channel.
        image_size: height and width.

    Returns:
        (D or 1, C or 1, height, width).
    """
    sums = kernels.sum((-2, -1))[..., None, None]
    channels = max([sums.shape[2], *(p.weight.shape[0] for p in layout if p.weight.dim() > 2)])
    image = sums.new_zeros((sums.shape[1], channels, *image_size))
    for total, patch in zip(sums, layout, strict=True):
        image[..., patch.top : patch.bottom, patch.left : patch.right] += patch.weight * total
    return image
