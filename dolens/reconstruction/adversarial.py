"""Adversarial losses train discriminators and a restoring network against each other."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.func import functional_call

from dolens.errors import InputError
from dolens.reconstruction.processes import mean_over_processes


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
