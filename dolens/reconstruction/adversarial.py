"""Discriminators score how real images look; adversarial losses train them with a network."""

import math
from collections.abc import Mapping
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.utils.parametrizations import spectral_norm

from dolens.errors import InputError
from dolens.reconstruction.processes import mean_over_processes
from dolens.reconstruction.unet import check_halvings


def relativistic_discriminator_loss(real: Tensor, fake: Tensor) -> Tensor:
    """Return the relativistic average least-squares loss of a discriminator, a scalar.

        ½ mean((D(x) − E D(G) − 1)²) + ½ mean((D(G) − E D(x) + 1)²)

    D(x) being the scores of true images, D(G) those of restored ones and E the mean over all of
    a kind (Jolicoeur-Martineau 2018; the RaGAN-LS of DeblurGAN-v2).  It is zero where every true
    image scores one more than the mean restored one, and conversely; 1 where all score alike.
    Processes that share a batch take E over all of it, so that the mean of their losses is its.

    Args:
        real: scores of true images, any shape.
        fake: scores of restored images, any shape.
    """
    mean_real, mean_fake = mean_over_processes(real.mean()), mean_over_processes(fake.mean())
    return 0.5 * (
        (real - mean_fake - 1.0).square().mean() + (fake - mean_real + 1.0).square().mean()
    )


def relativistic_generator_loss(real: Tensor, fake: Tensor) -> Tensor:
    """Return the relativistic average least-squares loss of a restoring network, a scalar.

        ½ mean((D(x) − E D(G) + 1)²) + ½ mean((D(G) − E D(x) − 1)²)

    The discriminator's loss with true and restored exchanged: it is zero where restored images
    score one more than true ones.  See `relativistic_discriminator_loss`.
    """
    return relativistic_discriminator_loss(real=fake, fake=real)


class RelativisticDiscriminators(nn.Module):
    """Average relativistic losses over discriminators at several scales.

    DeblurGAN-v2's double-scale discriminator is a `PatchDiscriminator`, local, beside a
    `GlobalDiscriminator`.  The caller minimises, with two optimizers,

        content + weight · generator_loss(real, fake)   over the restoring network,
        discriminator_loss(real, fake)                  over `parameters()`.

    Args:
        discriminators: each maps images (B, 3, H, W) to scores; the names are those in the
            state dict.
        weight: of the adversarial term beside the content loss; at 0 the term and the
            discriminators' own training may be left out.

    Raises:
        InputError: no discriminator, or a weight that is negative or not finite.
    """

    def __init__(self, discriminators: Mapping[str, nn.Module], weight: float = 0.01) -> None:
        super().__init__()
        if not discriminators:
            raise InputError("discriminators: at least one is needed, by name")
        if not (weight >= 0 and math.isfinite(weight)):
            raise InputError(f"weight={weight}: must be finite and at least 0")
        self.discriminators = nn.ModuleDict(dict(discriminators))
        self.weight = weight

    def discriminator_loss(self, real: Tensor, fake: Tensor) -> Tensor:
        """Return the discriminators' own loss, a scalar.

        Args:
            real: true images, sRGB, (B, 3, H, W).
            fake: restored images; no gradient reaches them or `real`.
        """
        # In one pass, so that both are judged after the same step of the spectral norms' power
        # iteration.
        images = torch.cat([real, fake]).detach()
        losses = [
            relativistic_discriminator_loss(*discriminator(images).tensor_split([len(real)]))
            for discriminator in self.discriminators.values()
        ]
        return torch.stack(losses).mean()

    def generator_loss(self, real: Tensor, fake: Tensor) -> Tensor:
        """Return the restoring network's adversarial loss, a scalar, not yet weighted.

        The discriminators are constants here: the gradient reaches `fake` alone, and neither
        their parameters nor the running vectors of their spectral norms change.

        Args:
            real: true images, sRGB, (B, 3, H, W).
            fake: restored images.
        """
        losses = []
        for discriminator in self.discriminators.values():
            constants = {name: value.detach() for name, value in discriminator.named_parameters()}
            # Copies, as the spectral norms' power iteration writes into its vectors.
            copies = {name: value.clone() for name, value in discriminator.named_buffers()}
            with torch.no_grad():
                real_scores = functional_call(discriminator, constants | copies, (real,))
            fake_scores = functional_call(discriminator, constants | copies, (fake,))
            losses.append(relativistic_generator_loss(real_scores, fake_scores))
        return torch.stack(losses).mean()


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
