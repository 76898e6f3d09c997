"""Photographs and lenses that a restorer of any lens is trained with."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from dolens.experiments.checks import check_count
from dolens.experiments.data.package_photographs import PackagePhotographsDataModule
from dolens.experiments.data.pretraining_photographs import (
    PRETRAINING_MANIFEST,
    pretraining_photographs,
)
from dolens.experiments.data.resumable import ResumableSampler
from dolens.experiments.pretraining.examples import Draws, Example, Examples
from dolens.experiments.pretraining.functions import function_bank
from dolens.experiments.pretraining.textures import dead_leaves, text

logger = logging.getLogger(__name__)

# Drawn pictures: of each kind, how often one is taken to one photograph, and their sides in pixels.
_DRAWN = ((dead_leaves, 36), (text, 20))
_DRAWN_WEIGHT, _DRAWN_SIDE = 0.6, 512


class PretrainingDataModule(PackagePhotographsDataModule):
    """Trains with `Examples` of many lenses, and judges with the photographs of packages.

    Training photographs are those of the manifest's own training split, of scikit-image, of further
    packages (see `pretraining_photographs`), and drawn ones.

    Args:
        lenses: cameras whose point spread functions are drawn at first.
        draws: how examples are drawn from them.
        further: a list of more photographs, see `pretraining_photographs`; None: the project's own.
        **photographs: the arguments of `PackagePhotographsDataModule`; its crop size, scales and
            flips are of validation and test alone.

    Raises:
        InputError: an argument out of range; at set-up, a file that is missing or altered.
    """

    def __init__(
        self, lenses: int, draws: Draws, further: str | None = None, **photographs: Any
    ) -> None:
        super().__init__(**photographs)
        check_count("data.lenses", lenses)
        self.further = PRETRAINING_MANIFEST if further is None else Path(further)
        self.lenses, self.draws = lenses, draws
        self.examples: Examples | None = None

    def setup(self, stage: str | None = None) -> None:
        """Read photographs and, for training, draw lenses; see `CropDataModule.setup`."""
        super().setup(stage)
        if stage == "fit" and self.examples is None:
            pictures = [(p.encoded, 1.0) for p in self.photographs("train")]
            further = pretraining_photographs(self.folders, self.further)
            pictures += [(photograph.encoded, weight) for photograph, weight in further]
            pictures += [(p, _DRAWN_WEIGHT) for p in _drawn(self.seed)]
            logger.info("%d pictures; drawing %d lenses", len(pictures), self.lenses)
            images, weights = zip(*pictures, strict=True)
            generator = torch.Generator().manual_seed(self.seed)
            functions, _ = function_bank(self.lenses, generator)
            self.examples = Examples(images, weights, functions, self.draws, self.seed)

    def train_dataloader(self) -> DataLoader[Example]:
        """Return batches of the present epoch, from the next one on."""
        assert self.examples is not None  # `setup` has made them
        options = self._loader_arguments() | {"pin_memory": False}
        sampler = ResumableSampler(self.steps_per_epoch, self._first_batch)
        return DataLoader(self.examples, sampler=sampler, batch_size=None, **options)

    def _first_batch(self) -> tuple[int, int]:
        first, remaining = self.first_sample()
        return first // self.batch_size, remaining // self.batch_size


def _drawn(seed: int) -> list[Tensor]:
    generator = np.random.default_rng(seed)
    return [draw(generator, _DRAWN_SIDE) for draw, count in _DRAWN for _ in range(count)]
