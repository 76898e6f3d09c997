"""Discriminators score how real an image looks, patch by patch or as a whole."""

from itertools import pairwise

from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from dolens.errors import InputError
from dolens.reconstruction.padding import check_halvings

_KERNEL = 4
_WIDEST = 8


class PatchDiscriminator(nn.Module):
    """Score every patch of an image: PatchGAN (Isola et al., 2017).

    `halvings` 4×4 convolutions of stride 2, then two of stride 1, leaky rectifiers between; the
    channels double from `width` up to 8·`width`.  A score sees a square of r pixels: r = 7 before
    the halvings, and each turns r into 2r + 2; one, two, three, … of them: 16, 34, 70, ….

    The convolutions are normalised by their spectral norm (Miyato et al., 2018), not by the
    statistics of images, so that a score neither depends on the other images of a small batch
    nor forgets an image's levels.

    Args:
        width: channels of the first stage.
        halvings: how many; 3 gives the usual patch of 70 pixels.

    Raises:
        InputError: `width` or `halvings` below 1, or `halvings` above 16.
    """

    def __init__(self, width: int = 64, halvings: int = 3) -> None:
        super().__init__()
        self.halvings = halvings
        *stem, deep = _stage_widths(width, halvings, stages=halvings + 1)
        self.layers = nn.Sequential(
            *_halvings(stem),
            _convolution(stem[-1], deep, stride=1),
            nn.LeakyReLU(0.2, inplace=True),
            _convolution(deep, 1, stride=1),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 3, H, W) to scores (B, 1, H/2ⁿ − 2, W/2ⁿ − 2), n = `halvings`, rounded down.

        Raises:
            InputError: an image without a single score.
        """
        _check_size(image, 3 * 2**self.halvings, self.halvings)
        return self.layers(image)


class GlobalDiscriminator(nn.Module):
    """Score an image as a whole.

    `halvings` 4×4 convolutions of stride 2 with leaky rectifiers, whose channels double from
    `width` up to 8·`width`; the mean over what remains of the image's area; a linear map of it.
    Normalised as `PatchDiscriminator` is.

    Args:
        width: channels of the first stage.
        halvings: how many; the features that are averaged see 3·2ⁿ − 2 pixels each, so that 5
            suit images of some 100 to 300 pixels.

    Raises:
        InputError: `width` or `halvings` below 1, or `halvings` above 16.
    """

    def __init__(self, width: int = 64, halvings: int = 5) -> None:
        super().__init__()
        self.halvings = halvings
        widths = _stage_widths(width, halvings, stages=halvings)
        self.layers = nn.Sequential(*_halvings(widths))
        self.score = spectral_norm(nn.Linear(widths[-1], 1))

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 3, H, W) to scores (B, 1).

        Raises:
            InputError: an image too small to be halved so often.
        """
        _check_size(image, 2**self.halvings, self.halvings)
        return self.score(self.layers(image).mean(dim=(-2, -1)))


def _stage_widths(width: int, halvings: int, stages: int) -> list[int]:
    """Return the number of channels of the image and of each stage."""
    for name, value in (("width", width), ("halvings", halvings)):
        if value < 1:
            raise InputError(f"discriminator {name}={value}: must be a whole number of at least 1")
    check_halvings("discriminator halvings", halvings)
    return [3, *(width * min(2**stage, _WIDEST) for stage in range(stages))]


def _halvings(widths: list[int]) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [_convolution(before, after, stride=2), nn.LeakyReLU(0.2, inplace=True)]
    return layers


def _convolution(before: int, after: int, stride: int) -> nn.Module:
    return spectral_norm(nn.Conv2d(before, after, _KERNEL, stride=stride, padding=1))


def _check_size(image: Tensor, smallest: int, halvings: int) -> None:
    if min(image.shape[-2:]) < smallest:
        raise InputError(
            f"images of {image.shape[-2]}×{image.shape[-1]} pixels: a discriminator with "
            f"halvings={halvings} needs at least {smallest}×{smallest}; choose fewer halvings"
        )
