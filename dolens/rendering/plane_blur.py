"""A lens's blur of planes, one kernel a plane and field."""

from dataclasses import dataclass

from torch import Tensor

from dolens.rendering.patch_convolution import convolve_patches
from dolens.rendering.patches import PatchLayout


@dataclass(frozen=True)
class PlaneBlur:
    """Convolution of planes with a lens's kernels, a scene's `Blur`.

    Attributes:
        kernels: (N, D or 1, C or 1, K, K), differentiable.
        layout: N patches, and where their pixels look.
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
        """What maps of ones become, (D or 1, C or 1, height, width)."""
        image = uniform_image(self.kernels, self.layout)
        return image if self.illumination is None else image * self.illumination


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
