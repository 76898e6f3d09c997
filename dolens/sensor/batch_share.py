"""A share of a batch: the images that one of several processes makes of it."""

from typing import NamedTuple

import torch
from torch import Tensor


class BatchShare(NamedTuple):
    """A `BatchShare` says which images of a larger batch a process has.

    Random numbers are drawn for the whole batch, and each process keeps its own part of them, so
    that all processes together see what one process would see.

    Attributes:
        first: number in the batch of the first image here.
        total: images of the whole batch.
    """

    first: int
    total: int

    def normal(self, like: Tensor, generator: torch.Generator) -> Tensor:
        """Draw standard normal numbers for the whole batch, and return those of this share.

        Args:
            like: (B, ...), the images here.
            generator: on their device.

        Returns:
            (B, ...), of the images' precision.
        """
        shape = (self.total, *like.shape[1:])
        drawn = torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)
        return drawn[self.first : self.first + len(like)]
