"""The generator of DeblurGAN-v2 is a feature pyramid over a classifier's stages."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction.backbones import Backbone
from dolens.reconstruction.unet import pad_to_multiple

_SLOPE = 0.2


class FeaturePyramid(nn.Module):
    """A `FeaturePyramid` maps images to images, through a backbone and a pyramid of its features.

    After Kupyn et al., DeblurGAN-v2, ICCV 2019, with P = `pyramid_channels` and the
    backbone's features Cₖ at stride 2ᵏ, k = 0 … n, C₀ being the image:

        Pₙ = lateral(Cₙ),   Pₖ = smooth(lateral(Cₖ) + ×2 Pₖ₊₁),   k = n − 1 … 2,
        merged = smooth([head(P₂), ×2 head(P₃), …, ×2ⁿ⁻² head(Pₙ)]),
        refined = smooth(×2 merged + lateral(C₁)),
        output = point(smooth(smooth([×2 refined, C₀]))).

    Laterals and the point are 1×1 convolutions, smoothings 3×3 ones, heads two of these; ×
    enlarges by repeating pixels.  Laterals and smoothings of k ≥ 2 have P channels, heads and
    `merged` P/2, what follows P/4.  The original ends with one 3×3 convolution of ×2 refined and
    sees the pixels themselves nowhere; blur of a few pixels, a lens's, is undone there.

    Nothing is normalised, for `Backbone`'s reasons, and the rectifiers are leaky: without
    normalisation a unit that has once fallen below zero everywhere would never rise again.

    Args:
        backbone: gives the features and takes the image's channels.
        out_channels: channels of the output.
        pyramid_channels: P, a multiple of 4.

    Rarely needed:
        zero_output: start with a last convolution of zeros, so that the output is zero and a
            residual network that adds it to its input begins as the identity.

    Raises:
        InputError: `pyramid_channels` not a positive multiple of 4.
    """

    def __init__(
        self,
        backbone: Backbone,
        out_channels: int,
        pyramid_channels: int = 64,
        zero_output: bool = False,
    ) -> None:
        super().__init__()
        if pyramid_channels < 4 or pyramid_channels % 4:
            raise InputError(
                f"pyramid_channels={pyramid_channels}: must be a positive multiple of 4"
            )
        whole, half, quarter = (pyramid_channels // part for part in (1, 2, 4))
        image, finest, *coarser = backbone.channels
        self.backbone = backbone
        self.laterals = nn.ModuleList(_lateral(width, whole) for width in coarser)
        self.smoothings = nn.ModuleList(_block(whole, whole) for _ in pairwise(coarser))
        self.heads = nn.ModuleList(
            nn.Sequential(_block(whole, half), _block(half, half)) for _ in coarser
        )
        self.merge = _block(half * len(coarser), half)
        self.finest_lateral = _lateral(finest, half)
        self.refine = _block(half, quarter)
        self.finish = nn.Sequential(_block(quarter + image, quarter), _block(quarter, quarter))
        self.output = nn.Conv2d(quarter, out_channels, kernel_size=1)
        if zero_output:
            nn.init.zeros_(self.output.weight)
            nn.init.zeros_(self.output.bias)  # type: ignore[arg-type]  # it has one
        # Channels last is how convolutions run fastest; see `UNet`.
        self.to(memory_format=torch.channels_last)

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, C, H, W), C the backbone's, to (B, out_channels, H, W), for any H and W.

        Sides that are no multiple of the backbone's stride are extended by repeating the last
        row or column and the result is cropped.
        """
        height, width = image.shape[-2:]
        padded = pad_to_multiple(image, self.backbone.stride)
        pixels, finest, *coarser = self.backbone(padded)
        levels = self._levels(coarser)
        heads = [
            _enlarge(head(level), 2**k)
            for k, (head, level) in enumerate(zip(self.heads, levels, strict=True))
        ]
        merged = self.merge(torch.cat(heads, dim=1))
        refined = self.refine(_enlarge(merged, 2) + self.finest_lateral(finest))
        finished = self.finish(torch.cat([_enlarge(refined, 2), pixels], dim=1))
        return self.output(finished)[..., :height, :width]

    def _levels(self, features: list[Tensor]) -> list[Tensor]:
        """Return the pyramid's levels P₂ … Pₙ from the features C₂ … Cₙ."""
        laterals = [
            lateral(values) for lateral, values in zip(self.laterals, features, strict=True)
        ]
        levels = [laterals.pop()]
        for lateral, smoothing in zip(reversed(laterals), self.smoothings, strict=True):
            levels.append(smoothing(lateral + _enlarge(levels[-1], 2)))
        return levels[::-1]


def _enlarge(features: Tensor, factor: int) -> Tensor:
    return functional.interpolate(features, scale_factor=factor, mode="nearest")


def _lateral(before: int, after: int) -> nn.Conv2d:
    return _initialised(nn.Conv2d(before, after, kernel_size=1), slope=1.0)


def _block(before: int, after: int) -> nn.Sequential:
    convolution = nn.Conv2d(before, after, kernel_size=3, padding=1)
    return nn.Sequential(
        _initialised(convolution, slope=_SLOPE), nn.LeakyReLU(_SLOPE, inplace=True)
    )


def _initialised(convolution: nn.Conv2d, slope: float) -> nn.Conv2d:
    # He et al. 2015: values keep their variance from layer to layer, as nothing normalises them.
    nn.init.kaiming_normal_(convolution.weight, a=slope, nonlinearity="leaky_relu")
    nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]  # it has one
    return convolution
