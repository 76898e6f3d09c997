"""Discriminators that train beside the network."""

from itertools import chain

import torch
from torch import Tensor, nn

from dolens.reconstruction import RelativisticDiscriminators
from dolens.reconstruction.processes import average_gradients, mean_over_processes


class Adversary(nn.Module):
    """Trains discriminators with an optimizer of their own, a step for each of the network's.

    Lightning's automatic optimization knows the network's optimizer alone; this one is stepped by
    hand, and its state goes into the checkpoint by the camera module.

    Args:
        discriminators: tell restored images from true ones.
        learning_rate: of the discriminators.
    """

    def __init__(self, discriminators: RelativisticDiscriminators, learning_rate: float) -> None:
        super().__init__()
        self.discriminators = discriminators
        self.optimizer = torch.optim.Adam(
            discriminators.parameters(), lr=learning_rate, betas=(0.5, 0.99)
        )

    def names(self) -> list[str]:
        """Return the names of all parameters and buffers."""
        return [name for name, _ in chain(self.named_parameters(), self.named_buffers())]

    def forward(self, real: Tensor, fake: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Make one step of the discriminators, and return their term of the network's loss.

        Args:
            real: true images, (B, 3, H, W), display-encoded.
            fake: restored ones.

        Returns:
            The weighted adversarial term, and numbers to log.
        """
        own = self.discriminators.discriminator_loss(real, fake)
        self.optimizer.zero_grad()
        own.backward()
        average_gradients(self.discriminators)
        self.optimizer.step()
        term = self.discriminators.generator_loss(real, fake)
        both = mean_over_processes(torch.stack((own.detach(), term.detach())))
        numbers = {"discriminator": both[0], "adversarial": both[1]}
        return self.discriminators.weight * term, numbers
