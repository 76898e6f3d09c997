"""The networks that turn a sensor image into the picture, behind one interface."""

import math
from typing import ClassVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.imaging.color import linear_to_srgb
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import wiener_deconvolve

COLORS = 3


class Restoration(nn.Module):
    """What every restoring network offers: `forward(raw, point_spread_functions)`.

    `needs_point_spread_function` tells the caller whether to compute the point spread
    functions at all; where it is False they are ignored and may be None.
    """

    needs_point_spread_function: ClassVar[bool]

    def forward(self, raw: Tensor, point_spread_functions: Tensor | None = None) -> Tensor:
        """Restore a picture from a sensor image.

        Args:
            raw: sensor image in linear light, (B, 3, H, W).
            point_spread_functions: (D, 3, K, K) for D depths, K odd, each centred on the pixel
                (K//2, K//2) and of unit sum where the lens loses no light; or None.

        Returns:
            (B, 3, H, W), sRGB-encoded, not clamped, in the dtype of the network: a float64
            lens may stand before a float32 network, and gradients reach it.
        """
        raise NotImplementedError

    @property
    def dtype(self) -> torch.dtype:
        """The floating-point type of the network's parameters."""
        return next(self.parameters()).dtype


class UNetRestoration(Restoration):
    """A U-Net alone, as in the supplement: encoded + UNet(encoded), encoded = sRGB(raw).

    It begins as the identity on the encoded image.

    Args:
        width: channels of the U-Net's first stage.
        depth: number of its halvings.
    """

    needs_point_spread_function: ClassVar[bool] = False

    def __init__(self, width: int = 16, depth: int = 3) -> None:
        super().__init__()
        self.network = UNet(COLORS, COLORS, width=width, depth=depth, zero_output=True)

    def forward(self, raw: Tensor, point_spread_functions: Tensor | None = None) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`."""
        encoded = linear_to_srgb(raw.to(self.dtype))
        return encoded + self.network(encoded)


class WienerUNetRestoration(Restoration):
    """Wiener deconvolution in linear light, then a U-Net that mends what it leaves.

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

    def forward(self, raw: Tensor, point_spread_functions: Tensor | None = None) -> Tensor:
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
