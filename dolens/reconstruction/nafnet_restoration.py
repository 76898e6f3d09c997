"""NAFNet restores alone, or behind a Wiener deconvolution."""

from collections.abc import Sequence

from dolens.reconstruction.feature_wiener import (
    NOISE_TO_SIGNAL,
    DeconvolvedRestoration,
    input_channels,
)
from dolens.reconstruction.field_coordinates import FIELD_CHANNELS
from dolens.reconstruction.nafnet import NAFNet
from dolens.reconstruction.opponent_wiener import OpponentWiener
from dolens.reconstruction.restoration import COLORS, ResidualRestoration


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
