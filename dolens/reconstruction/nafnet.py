"""NAFNet is a convolutional network with products in place of activations; it restores alone, or
behind a Wiener deconvolution.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction.feature_wiener import (
    NOISE_TO_SIGNAL,
    DeconvolvedRestoration,
    input_channels,
)
from dolens.reconstruction.opponent_wiener import OpponentWiener
from dolens.reconstruction.restoration import COLORS, FIELD_CHANNELS, ResidualRestoration
from dolens.reconstruction.unet import check_halvings, pad_to_multiple


class NAFNet(nn.Module):
    """A `NAFNet` maps images to images, through halvings and as many doublings whose results are
    added.

    The baseline of Chen et al. 2022 ("Simple Baselines for Image Restoration").  Stage k has
    width·2ᵏ channels; a 2×2 convolution of stride 2 leads down, a 1×1 convolution and a
    rearrangement of channels into pixels lead up.  Blocks begin as the identity.

    With `fold` n > 1 the network works on groups of n×n pixels, whose values are its channels:
    1/n² of the work at the same width.

    Args:
        in_channels: channels of the input.
        out_channels: channels of the output.
        width: channels of the first stage.
        down: blocks of each stage on the way down; their number is the number of halvings.
        middle: blocks at the coarsest stage.
        up: blocks of each stage on the way up, from coarse to fine.

    Rarely needed:
        fold: pixels along each side of a group.
        channel_attention: whether channels are weighed by their means over the image.  With it
            a pixel depends on the whole image, and a picture on what surrounds it.
        zero_output: start with a last convolution of zeros, so that the output is zero and a
            residual network that adds it to its input begins as the identity.

    Raises:
        InputError: a number of channels, `width` or `fold` below 1, a number of blocks below 0,
            or stages up that are not as many as those down.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int = 32,
        down: Sequence[int] = (1, 1, 1),
        middle: int = 1,
        up: Sequence[int] = (1, 1, 1),
        fold: int = 2,
        channel_attention: bool = True,
        zero_output: bool = False,
    ) -> None:
        super().__init__()
        sizes = {
            "in_channels": in_channels,
            "out_channels": out_channels,
            "width": width,
            "fold": fold,
        }
        for name, value in sizes.items():
            if value < 1:
                raise InputError(f"NAFNet {name}={value}: must be a whole number of at least 1")
        down, up = list(down), list(up)
        if len(down) != len(up) or min([middle, *down, *up]) < 0:
            raise InputError(
                f"NAFNet down={down}, middle={middle}, up={up}: must be numbers of blocks of at "
                "least 0, and as many stages up as down"
            )
        check_halvings("NAFNet stages", len(down))
        self.fold = fold
        self.multiple = fold * 2 ** len(down)

        def blocks(count: int, channels: int) -> nn.Sequential:
            return nn.Sequential(*(NAFBlock(channels, channel_attention) for _ in range(count)))

        widths = [width * 2**stage for stage in range(len(down) + 1)]
        self.input = nn.Conv2d(in_channels * fold**2, width, kernel_size=3, padding=1)
        self.down = nn.ModuleList(blocks(n, c) for n, c in zip(down, widths, strict=False))
        self.halve = nn.ModuleList(
            nn.Conv2d(c, 2 * c, kernel_size=2, stride=2) for c in widths[:-1]
        )
        self.middle = blocks(middle, widths[-1])
        self.lift = nn.ModuleList(
            nn.Conv2d(c, 2 * c, kernel_size=1, bias=False) for c in widths[:0:-1]
        )
        self.up = nn.ModuleList(blocks(n, c) for n, c in zip(up, widths[-2::-1], strict=True))
        self.output = nn.Conv2d(width, out_channels * fold**2, kernel_size=3, padding=1)
        if zero_output:
            nn.init.zeros_(self.output.weight)
            nn.init.zeros_(self.output.bias)  # type: ignore[arg-type]  # it has one
        self.to(memory_format=torch.channels_last)  # as in `UNet`

    def forward(self, image: Tensor, shift: Tensor | None = None) -> Tensor:
        """Map (B, in_channels, H, W) to (B, out_channels, H, W), for any H and W.

        A `shift` (B, width, 1, 1) is added to what enters the first stage: what is known of the
        whole image.

        Sides that are no multiple of `multiple` are extended by repeating the last row or column
        and the result is cropped.
        """
        height, width = image.shape[-2:]
        features = functional.pixel_unshuffle(pad_to_multiple(image, self.multiple), self.fold)
        features = self.input(features)
        if shift is not None:
            features = features + shift
        skips: list[Tensor] = []
        for blocks, halve in zip(self.down, self.halve, strict=True):
            features = blocks(features)
            skips.append(features)
            features = halve(features)
        features = self.middle(features)
        for lift, blocks in zip(self.lift, self.up, strict=True):
            features = blocks(functional.pixel_shuffle(lift(features), 2) + skips.pop())
        return functional.pixel_shuffle(self.output(features), self.fold)[..., :height, :width]


class NAFBlock(nn.Module):
    """A block of NAFNet: two residual parts, the first of which looks at neighbouring pixels.

        y = x + β·C₁(A(gate(D₃(C₂(norm(x))))))
        z = y + γ·C₁(gate(C₂(norm(y))))

    C₂ doubles the channels by 1×1 convolution, D₃ is a 3×3 convolution of each channel by itself,
    gate(u, v) = u·v multiplies one half of the channels by the other, A weighs channels by a linear
    function of their means over the image, C₁ is a 1×1 convolution, and norm makes the channels
    of each pixel of mean 0 and variance 1.  β and γ begin as zero.

    Args:
        channels: of input and output.
        channel_attention: whether there is A.
    """

    def __init__(self, channels: int, channel_attention: bool = True) -> None:
        super().__init__()
        self.mixer_norm = PixelNorm(channels)
        self.widen = nn.Conv2d(channels, 2 * channels, kernel_size=1)
        self.neighbours = nn.Conv2d(
            2 * channels, 2 * channels, kernel_size=3, padding=1, groups=2 * channels
        )
        self.attention = nn.Conv2d(channels, channels, kernel_size=1) if channel_attention else None
        self.project = nn.Conv2d(channels, channels, kernel_size=1)
        self.pointwise_norm = PixelNorm(channels)
        self.pointwise_widen = nn.Conv2d(channels, 2 * channels, kernel_size=1)
        self.pointwise_project = nn.Conv2d(channels, channels, kernel_size=1)
        self.beta = nn.Parameter(torch.zeros(1, channels, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, channels, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map features (B, channels, H, W) to the same shape."""
        mixed = _gate(self.neighbours(self.widen(self.mixer_norm(x))))
        if self.attention is not None:
            mixed = mixed * self.attention(mixed.mean((-2, -1), keepdim=True))
        x = x + self.beta * self.project(mixed)
        pointwise = _gate(self.pointwise_widen(self.pointwise_norm(x)))
        return x + self.gamma * self.pointwise_project(pointwise)


class PixelNorm(nn.LayerNorm):
    """Give the channels of each pixel mean 0 and variance 1, then learned ones.

    No statistics of an image or a batch: training and evaluation do the same.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Map features (B, C, H, W) to the same shape."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def _gate(features: Tensor) -> Tensor:
    first, second = features.chunk(2, dim=1)
    return first * second


class NAFNetRestoration(ResidualRestoration):
    """Restore by a NAFNet alone.

    It begins as the identity on the encoded image.

    Args:
        width: channels of its first stage.
        down: blocks of each stage on the way down.
        middle: blocks at the coarsest stage.
        up: blocks of each stage on the way up.
        fold: pixels along each side of the groups that it works on.
        channel_attention: whether channels are weighed by their means over the image.
        field_coordinates: whether it is told where on the sensor a pixel lies.

    Raises:
        InputError: a number out of range; see `NAFNet`.
    """

    def __init__(
        self,
        width: int = 32,
        down: Sequence[int] = (1, 1, 1),
        middle: int = 1,
        up: Sequence[int] = (1, 1, 1),
        fold: int = 2,
        channel_attention: bool = True,
        field_coordinates: bool = False,
    ) -> None:
        channels = COLORS + FIELD_CHANNELS * field_coordinates
        network = NAFNet(channels, COLORS, width, down, middle, up, fold, channel_attention, True)
        super().__init__(network, field_coordinates)


class WienerNAFNetRestoration(DeconvolvedRestoration):
    """Restore by Wiener deconvolution of opponent colours, followed by a NAFNet.

    It begins as the deconvolution alone.

    Args:
        width: channels of the NAFNet's first stage.
        down: blocks of each stage on the way down.
        middle: blocks at the coarsest stage.
        up: blocks of each stage on the way up.
        fold: pixels along each side of the groups that it works on.
        channel_attention: whether channels are weighed by their means over the image.
        margin: pixels added at each edge for the deconvolution; see `wiener_deconvolve`.
        noise_to_signal: initial r of luminance and of both differences of colours.
        depths: number of the camera's point spread functions, which are deconvolved with one by
            one besides; 0: the network knows their mean alone.
        field_coordinates: whether the NAFNet is told where on the sensor a pixel lies.

    Raises:
        InputError: a number out of range; see `NAFNet` and `OpponentWiener`.
    """

    def __init__(
        self,
        width: int = 32,
        down: Sequence[int] = (1, 1, 1),
        middle: int = 1,
        up: Sequence[int] = (1, 1, 1),
        fold: int = 2,
        channel_attention: bool = True,
        margin: int = 32,
        noise_to_signal: Sequence[float] = NOISE_TO_SIGNAL,
        depths: int = 0,
        field_coordinates: bool = False,
    ) -> None:
        channels = input_channels(depths, field_coordinates)
        network = NAFNet(channels, COLORS, width, down, middle, up, fold, channel_attention, True)
        super().__init__(
            OpponentWiener(margin, noise_to_signal, depths), network, field_coordinates
        )
