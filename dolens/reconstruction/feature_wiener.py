"""A network restores from several Wiener deconvolutions: of opponent colours, and of features that
are learned.
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.reconstruction.opponent_wiener import OpponentWiener, check_functions, correlations
from dolens.reconstruction.restoration import (
    COLORS,
    FIELD_CHANNELS,
    Restoration,
    required_field,
    with_field_channels,
)
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import (
    close_periodically,
    padded_lengths,
    squared_frequency,
    transfer_function,
)
from dolens.sensor.colour import linear_to_srgb

# Initial noise over signal power at the Nyquist frequency: luminance, red against blue, green
# against both.  Fitted to photographs at 100 electrons of white.
NOISE_TO_SIGNAL = (1.0, 7.0, 20.0)
# Values along each side of the kernels of learned features.
_KERNEL = 5


class DeconvolvedRestoration(Restoration):
    """Restore by Wiener deconvolution of opponent colours, followed by a network.

        restored = e + network([e, e_1, …, e_D, sRGB(raw), others]),   e = sRGB(wiener(raw)),

    e being by one filter for all depths, and e_d, where `wiener.depths` is not 0, by that of one
    depth; see `OpponentWiener`.  It begins as e where the network begins as zero.

    Args:
        wiener: the deconvolution.
        network: maps `input_channels(...)` channels to three.
        field_coordinates: whether the network is told where on the sensor a pixel lies.
    """

    needs_point_spread_function: ClassVar[bool] = True

    def __init__(self, wiener: OpponentWiener, network: nn.Module, field_coordinates: bool) -> None:
        super().__init__()
        self.needs_field = field_coordinates
        self.wiener = wiener
        self.network = network

    def others(self, raw: Tensor, functions: Tensor) -> list[Tensor]:
        """Return further channels (B, C, H, W) for the network; none here."""
        return []

    def filtered(self, raw: Tensor, point_spread_functions: Tensor) -> Tensor:
        """Return e, the pictures (B, 3, H, W) of the deconvolution alone, sRGB-encoded."""
        return linear_to_srgb(self.wiener(raw.to(self.dtype), point_spread_functions)[:, 0])

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `point_spread_functions` is None or not of shape (D, 3, K, K), or `field` is
                needed, and is None or not of shape (B, 2, H, W).
        """
        raw = raw.to(self.dtype)
        pictures = linear_to_srgb(self.wiener(raw, point_spread_functions))
        assert point_spread_functions is not None  # the deconvolution has looked
        others = self.others(raw, point_spread_functions.to(raw))
        seen = torch.cat([pictures.flatten(1, 2), linear_to_srgb(raw), *others], dim=1)
        if self.needs_field:
            seen = with_field_channels(seen, required_field(field, type(self).__name__))
        return pictures[:, 0] + self.network(seen)


def input_channels(depths: int, field_coordinates: bool, others: int = 0) -> int:
    """Return the channels that a network of `DeconvolvedRestoration` sees."""
    return COLORS * (2 + depths) + others + FIELD_CHANNELS * field_coordinates


class FeatureWienerRestoration(DeconvolvedRestoration):
    """Restore by Wiener deconvolution of opponent colours and of learned features, then a U-Net.

    Convolution commutes with blur, so a feature g*raw of the sensor's image is that feature of the
    truth, blurred, with noise, and can be deconvolved by a filter of its own (Dong, Roth and
    Schiele, NeurIPS 2020).  Opponent colours are features that are known to be good; `features`
    more are learned; see `LearnedFeatures`.  It begins as the deconvolution of opponent colours.

    Args:
        width: channels of the U-Net's first stage.
        depth: number of its halvings.
        margin: pixels added at each edge for the deconvolution; see `wiener_deconvolve`.
        noise_to_signal: initial r of luminance and of both differences of colours, noise over
            signal power at the Nyquist frequency.
        depths: number of the camera's point spread functions, which are deconvolved with one by
            one besides; 0: the network knows their mean alone.
        features: learned features of each scale; 0 for none.
        scales: of the features, 1 to 3: kernels reach 1, 2 and 4 times as far.
        field_coordinates: whether the U-Net is told where on the sensor a pixel lies.

    Raises:
        InputError: a number out of range.
    """

    def __init__(
        self,
        width: int = 16,
        depth: int = 3,
        margin: int = 32,
        noise_to_signal: Sequence[float] = NOISE_TO_SIGNAL,
        depths: int = 0,
        features: int = 0,
        scales: int = 1,
        field_coordinates: bool = False,
    ) -> None:
        if features < 0:
            raise InputError(f"features={features}: must be at least 0")
        if scales not in (1, 2, 3):
            raise InputError(f"scales={scales}: must be 1, 2 or 3")
        wiener = OpponentWiener(margin, noise_to_signal, depths)
        channels = input_channels(depths, field_coordinates, features * scales)
        network = UNet(channels, COLORS, width=width, depth=depth, zero_output=True)
        super().__init__(wiener, network, field_coordinates)
        self.features = LearnedFeatures(features, scales, margin) if features else None

    def others(self, raw: Tensor, functions: Tensor) -> list[Tensor]:
        """Return the learned features, deconvolved."""
        return [] if self.features is None else [self.features(raw, functions)]


class LearnedFeatures(nn.Module):
    """Learned features of a sensor's image, each deconvolved by a Wiener filter of its own.

    Feature i is Σ_c g_ic * wiener(raw_c, r_i) over colours c: a learned convolution with kernels g
    of 5×5 pixels, of the picture that the filter with the noise-to-signal ratio r_i leaves.  The r
    are learned; they begin between 0.1 and 100, so that some features are sharp and others free of
    noise.  Where the depth is unknown the filter is that of least mean error over the depths.

    Args:
        features: of each scale.
        scales: kernels of scale s have their 5×5 values 2ˢ pixels apart.
        margin: pixels added at each edge for the deconvolution.
    """

    def __init__(self, features: int, scales: int, margin: int) -> None:
        super().__init__()
        self.margin = margin
        count = features * scales
        # Of unit power over 5×5 pixels of three colours.
        kernels = torch.randn(count, COLORS, _KERNEL, _KERNEL) / math.sqrt(COLORS * _KERNEL**2)
        self.kernels = nn.Parameter(kernels)
        spread = torch.linspace(math.log(0.1), math.log(100.0), features)
        self.log_noise_to_signal = nn.Parameter(spread.repeat(scales))
        self.spacings = [2**scale for scale in range(scales) for _ in range(features)]

    def forward(self, raw: Tensor, functions: Tensor) -> Tensor:
        """Return (B, features·scales, H, W) of images (B, 3, H, W) and functions (D, 3, K, K)."""
        height, width = raw.shape[-2:]
        filters, columns = self.filters(functions, height, width)
        rows = filters.shape[-2]
        spectrum = torch.fft.rfft2(close_periodically(raw, rows, columns))
        found = torch.einsum("fcuv,bcuv->bfuv", filters, spectrum)
        return torch.fft.irfft2(found, s=(rows, columns))[..., :height, :width]

    def filters(self, functions: Tensor, height: int, width: int) -> tuple[Tensor, int]:
        """Return filters (features·scales, 3, R, C // 2 + 1), complex, to a feature from a colour,
        and C; see `OpponentWiener.filters`.
        """
        check_functions(functions)
        size = max(functions.shape[-1], max(self.spacings) * (_KERNEL - 1) + 1)
        rows, columns = padded_lengths(height, width, self.margin, size)
        matched, power = correlations(functions, rows, columns)
        ratio = self.log_noise_to_signal.exp()[:, None, None, None]
        prior = squared_frequency(rows, columns, power) * ratio
        weight = matched / (power + prior).clamp(min=torch.finfo(power.dtype).eps)
        return weight * self._kernel_transforms(rows, columns), columns

    def _kernel_transforms(self, rows: int, columns: int) -> Tensor:
        found = []
        for kernel, spacing in zip(self.kernels, self.spacings, strict=True):
            side = spacing * (_KERNEL - 1) + 1
            spread = kernel.new_zeros(COLORS, side, side)
            spread[:, ::spacing, ::spacing] = kernel
            found.append(transfer_function(spread, rows, columns))
        return torch.stack(found)
