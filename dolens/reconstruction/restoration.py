"""Restoring networks turn a sensor image into a picture, behind one interface.

Field coordinates give a network the position of each pixel, because blur varies over the field.
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.reconstruction.backbones import load_backbone
from dolens.reconstruction.feature_pyramid import FeaturePyramid
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import wiener_deconvolve
from dolens.sensor.colour import linear_to_srgb

COLORS = 3


class Restoration(nn.Module):
    """A restoring network offers `forward(raw, point_spread_functions, field)`.

    `needs_point_spread_function` and `needs_field` tell the caller whether to compute the point
    spread functions and the field coordinates at all; where one is False they are ignored and
    may be None.  Where `needs_noise` is True, `forward` takes the sensor's noise besides, (2,): its
    variance at light x is noise[0]·x + noise[1].  Where `takes_functions_of_images` is True, each
    image may have functions of its own; where `takes_readouts` is, an image may be N readouts with
    functions and noise of each: see `functions_of_each`.  `pretrained` tells whether any of the
    network began with trained weights, `restores_already` whether all of it did, for restoring
    pictures.
    """

    needs_point_spread_function: ClassVar[bool] = False
    needs_field: bool = False
    needs_noise: ClassVar[bool] = False
    takes_functions_of_images: ClassVar[bool] = False
    takes_readouts: ClassVar[bool] = False
    pretrained: bool = False
    restores_already: bool = False

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore a picture from a sensor image.

        Args:
            raw: sensor image in linear light, (B, 3, H, W).
            point_spread_functions: (D, 3, K, K) for D depths, K odd, each centred on the pixel
                (K//2, K//2) and of unit sum where the lens loses no light; of each image,
                (B, D, 3, K, K), where the network takes such; or None.
            field: position of each pixel on the sensor, (B, 2, H, W): x and y over half the
                sensor's diagonal, so that its corners have radius 1; or None.

        Returns:
            (B, 3, H, W), sRGB-encoded, not clamped, in the dtype of the network: a float64
            lens may stand before a float32 network, and gradients reach it.

        Raises:
            InputError: an argument that the network needs is None or of another shape.
        """
        raise NotImplementedError

    def noise_arguments(self, noise: Sequence[float] | Sequence[Sequence[float]]) -> list[Tensor]:
        """Return what `forward` takes after the field: the noise (2,), or (N, 2) of readouts, where
        it is asked for.
        """
        return [torch.tensor(noise)] if self.needs_noise else []

    def functions_and_noise(
        self, functions: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return point spread functions and noise, of a network that needs both.

        Raises:
            InputError: one of them is None.
        """
        if functions is None or noise is None:
            raise InputError(
                f"{type(self).__name__} needs the lens's point spread functions and the sensor's "
                "noise: use a renderer that gives them"
            )
        return functions, noise

    @property
    def dtype(self) -> torch.dtype:
        """Return the floating-point type of the parameters, or of the buffers if there are none."""
        tensors = (*self.parameters(), *self.buffers())
        found = (tensor.dtype for tensor in tensors if tensor.is_floating_point())
        return next(found, torch.get_default_dtype())


class ResidualRestoration(Restoration):
    """A residual network predicts the difference between the encoded image and the truth.

        restored = encoded + network(encoded),   encoded = sRGB(raw),

    or network([encoded, x, y, r²]) with field coordinates: see `field_channels`.

    Args:
        network: maps (B, 3, H, W), or (B, 6, H, W) with field coordinates, to (B, 3, H, W).
        field_coordinates: whether the network is told where on the sensor a pixel lies, as
            blur varies over the field.
    """

    needs_point_spread_function: ClassVar[bool] = False

    def __init__(self, network: nn.Module, field_coordinates: bool) -> None:
        super().__init__()
        self.needs_field = field_coordinates
        self.network = network

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `field` is needed, and is None or not of shape (B, 2, H, W).
        """
        encoded = linear_to_srgb(raw.to(self.dtype))
        if not self.needs_field:
            return encoded + self.network(encoded)
        field = required_field(field, type(self).__name__)
        return encoded + self.network(with_field_channels(encoded, field))


class UNetRestoration(ResidualRestoration):
    """Restore by a U-Net alone, as in the supplement.

    It begins as the identity on the encoded image.

    Args:
        width: channels of the U-Net's first stage.
        depth: number of its halvings.
        field_coordinates: whether it is told where on the sensor a pixel lies.
    """

    def __init__(self, width: int = 16, depth: int = 3, field_coordinates: bool = False) -> None:
        channels = _channels(field_coordinates)
        network = UNet(channels, COLORS, width=width, depth=depth, zero_output=True)
        super().__init__(network, field_coordinates)


class FeaturePyramidRestoration(ResidualRestoration):
    """Restore by the generator of DeblurGAN-v2, a feature pyramid over a classifier's layers.

    It begins as the identity on the encoded image.

    Args:
        backbone: "mobilenet_v2" or "googlenet", the Inception network.
        stages: of the backbone, from 2 to 5; 5, as in the original, sees at 1/32.
        pyramid_channels: of the pyramid, a multiple of 4; see `FeaturePyramid`.
        field_coordinates: whether it is told where on the sensor a pixel lies.
        weights: "imagenet" requires trained weights for the backbone, from a file or the torch
            cache; "auto" starts at random, with a warning, where there are none; "download"
            requires them, and downloads them where there are none; "none" starts at random.

    Rarely needed:
        width_multiplier: of a MobileNetV2's channels; trained weights are published for 1.
        weights_file: a file of them; None for the torch cache.

    Raises:
        InputError: a word or a number that is not allowed, or a wrong file.
        PretrainedWeightsUnavailable: `weights` requires them and none were found.
    """

    def __init__(
        self,
        backbone: str = "mobilenet_v2",
        stages: int = 5,
        width_multiplier: float = 1.0,
        pyramid_channels: int = 64,
        field_coordinates: bool = False,
        weights: str = "auto",
        weights_file: str | None = None,
    ) -> None:
        channels = _channels(field_coordinates)
        layers = load_backbone(backbone, channels, stages, width_multiplier, weights, weights_file)
        network = FeaturePyramid(layers, COLORS, pyramid_channels, zero_output=True)
        super().__init__(network, field_coordinates)
        self.pretrained = layers.pretrained


class WienerUNetRestoration(Restoration):
    """Restore by Wiener deconvolution in linear light, followed by a U-Net.

    The point spread functions are averaged over the depths: the deconvolution is one for all
    of them, as it must be where the depth of a pixel is unknown.  Both the deconvolved and the
    raw image, sRGB-encoded, enter the U-Net, and its output is added to the former:

        restored = e + UNet([e, sRGB(raw)]),   e = sRGB(wiener(raw, mean PSF, r)).

    It begins as the deconvolution alone.  The noise-to-signal ratio r of each colour channel
    is learned through its logarithm, which keeps it positive.

    Args:
        width: channels of the U-Net's first stage.
        depth: number of its halvings.
        margin: pixels added at each edge for the deconvolution; see `wiener_deconvolve`.
        noise_to_signal: initial r, noise over signal power at the Nyquist frequency.

    Raises:
        InputError: `noise_to_signal` not positive or `margin` negative.
    """

    needs_point_spread_function: ClassVar[bool] = True

    def __init__(
        self, width: int = 16, depth: int = 3, margin: int = 32, noise_to_signal: float = 1e-2
    ) -> None:
        super().__init__()
        if not (noise_to_signal > 0 and math.isfinite(noise_to_signal)):
            raise InputError(f"noise_to_signal={noise_to_signal}: must be positive and finite")
        if margin < 0:
            raise InputError(f"margin={margin}: must be at least 0 pixels")
        self.margin = margin
        self.log_noise_to_signal = nn.Parameter(torch.full((COLORS,), math.log(noise_to_signal)))
        self.network = UNet(2 * COLORS, COLORS, width=width, depth=depth, zero_output=True)

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `point_spread_functions` is None or not of shape (D, 3, K, K).
        """
        if point_spread_functions is None:
            raise InputError(
                "WienerUNetRestoration needs the lens's point spread functions, got None: "
                "use a renderer that gives them, or UNetRestoration, which works without"
            )
        if point_spread_functions.ndim != 4:
            raise InputError(
                f"point_spread_functions of shape {tuple(point_spread_functions.shape)}: "
                "expected (depths, 3, K, K)"
            )
        raw = raw.to(self.dtype)
        deconvolved = wiener_deconvolve(
            raw,
            point_spread_functions.to(self.dtype).mean(dim=0),
            self.log_noise_to_signal.exp(),
            self.margin,
        )
        encoded = linear_to_srgb(deconvolved)
        return encoded + self.network(torch.cat([encoded, linear_to_srgb(raw)], dim=1))


def _channels(field_coordinates: bool) -> int:
    return COLORS + FIELD_CHANNELS if field_coordinates else COLORS


FIELD_CHANNELS = 3


def field_channels(field: Tensor) -> Tensor:
    """Turn coordinates (B, 2, H, W) into the channels x, y and r² = x² + y², (B, 3, H, W).

    x and y tell the sagittal direction from the tangential.  r² is there because a centred
    lens's blur grows with even powers of r, and a convolution, being linear, cannot make the
    first of them from x and y; r itself has a kink on the axis.
    """
    return torch.cat([field, field.square().sum(dim=1, keepdim=True)], dim=1)


def with_field_channels(image: Tensor, field: Tensor) -> Tensor:
    """Append the field's channels to an image: (B, C, H, W) and (B, 2, H, W) → (B, C + 3, H, W).

    The field takes the image's dtype.

    Raises:
        InputError: the field is not of shape (B, 2, H, W) with the image's B, H and W.
    """
    batch, _, height, width = image.shape
    if field.shape != (batch, 2, height, width):
        raise InputError(
            f"field of shape {tuple(field.shape)}: must be {(batch, 2, height, width)}, x and y "
            "of each pixel over half the sensor's diagonal"
        )
    return torch.cat([image, field_channels(field.to(image.dtype))], dim=1)


def required_field(field: Tensor | None, network: str) -> Tensor:
    """Return the field that a network with field coordinates needs.

    Args:
        field: (B, 2, H, W), or None.
        network: its class's name; the message begins with it.

    Raises:
        InputError: the field is None.
    """
    if field is None:
        raise InputError(
            f"{network} with field_coordinates=true needs `field`, the pixels' coordinates on the "
            "sensor, got None: give (B, 2, H, W), or field_coordinates=false"
        )
    return field
