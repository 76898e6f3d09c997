"""Photographs of a validation are logged as pictures, and scores of a test as tables."""

from pathlib import Path
from typing import NamedTuple

import lightning
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.photograph_scores import table_name
from dolens.experiments.camera.reconstruction import evaluating
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.data.photographs import shown_name
from dolens.experiments.loggers.protocol import TakesPictures
from dolens.experiments.tables import write_table
from dolens.reconstruction import psnr_db
from dolens.reconstruction.processes import gathered
from dolens.sensor.colour import linear_to_srgb
from dolens.tasks import stage

_GAP, _TEXT = 4, 15  # pixels between pictures, and of the line of text above them
# Wider pictures are cut to their middle: a log is no archive.
_WIDEST = 256


class ValidationPictures(lightning.Callback):
    """Logs truth, sensor's image and restored image side by side, with their PSNR.

    The pictures are called `<photograph>/<view>`, as `chelsea/8m`; each shows the same crop
    every time, the photograph's first, with the noise with which validation measures it.

    Args:
        photographs: how many, spread over those of validation.
        times: how often at most in a training, evenly spaced, the last time after its last epoch.

    Raises:
        InputError: a number below 1.
    """

    def __init__(self, photographs: int = 3, times: int = 8) -> None:
        for name, value in (("photographs", photographs), ("times", times)):
            if value < 1:
                raise InputError(
                    f"callbacks.validation_pictures: {name} {value}; allowed: 1 or more"
                )
        self.photographs, self.times = photographs, times
        self._crops: dict[int, str] = {}
        self._found: list[_Picture] = []

    def on_validation_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Choose the crops, if it is time for pictures."""
        self._crops, self._found = {}, []
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        kept = any(isinstance(entry, TakesPictures) for entry in trainer.loggers)
        if find is None or not kept or trainer.sanity_checking or not self._due(trainer):
            return
        first: dict[str, int] = {}
        for crop, name in enumerate(find("validation")):
            first.setdefault(name, crop)
        names = list(first)
        count = min(self.photographs, len(names))
        chosen = [names[(2 * n + 1) * len(names) // (2 * count)] for n in range(count)]
        self._crops = {first[name]: name for name in chosen}

    def _due(self, trainer: lightning.Trainer) -> bool:
        """Return whether this epoch's validation is among those that pictures are logged of."""
        epoch, epochs = trainer.current_epoch, trainer.max_epochs or 0
        every = trainer.check_val_every_n_epoch or 1
        validations = epochs // every
        if validations <= self.times:  # all; or training without an end in epochs
            return validations > 0 or epoch % self.times == 0
        # Of validations 1 … V those where n·times/V passes a whole number: the last is among them.
        number = (epoch + 1) // every
        return number * self.times // validations > (number - 1) * self.times // validations

    @torch.no_grad()
    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: object,
        batch: Tensor,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Make the pictures of the chosen crops in this batch."""
        if not isinstance(pl_module, Camera) or not self._crops:
            return
        number = pl_module.evaluation_batch("val", batch_idx)
        first = number * getattr(trainer.datamodule, "batch_size", len(batch))
        chosen = {n: self._crops.get(first + n) for n in range(len(batch))}
        if not any(chosen.values()):
            return
        with stage("pictures"), evaluating(pl_module.network):
            taken, functions = pl_module.take(pl_module.variables(), Shot(batch, "val", number))
            restored = pl_module.restore(taken, functions).clamp(0.0, 1.0).float().cpu()
        truth, raw = taken.truth.float().cpu(), linear_to_srgb(taken.raw).float().cpu()
        for crop, photograph in chosen.items():
            for view, label in enumerate(pl_module.views.labels()):
                if photograph is not None:
                    images = (truth[crop, view], raw[crop, view], restored[crop, view])
                    name = f"{shown_name(photograph)}/{label}"
                    self._found.append(_picture(first + crop, name, *images))

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Log the pictures, those of other processes too."""
        if not self._crops:
            return
        found = {(p.crop, p.name): p for part in gathered(self._found) for p in part}
        self._found = []
        for picture in sorted(found.values(), key=lambda p: p.crop):
            for entry in trainer.loggers:
                if isinstance(entry, TakesPictures):
                    entry.log_picture(
                        picture.name, picture.pixels, trainer.global_step, picture.caption
                    )


class _Picture(NamedTuple):
    """A picture of a crop, by its number among those of validation."""

    crop: int
    name: str
    pixels: np.ndarray
    caption: str


def _picture(crop: int, name: str, truth: Tensor, raw: Tensor, restored: Tensor) -> _Picture:
    of_sensor, of_network = (float(psnr_db(i[None], truth[None])) for i in (raw, restored))
    texts = ("truth", f"sensor {of_sensor:.2f} dB", f"restored {of_network:.2f} dB")
    pixels = side_by_side(dict(zip(texts, (truth, raw, restored), strict=True)))
    return _Picture(crop, name, pixels, ", ".join(texts[1:]))


def side_by_side(images: dict[str, Tensor]) -> np.ndarray:
    """Return images in a row, each under its text.

    Args:
        images: text → (3, H, W), 0 to 1, display-encoded, all of one shape.

    Returns:
        (height, width, 3), uint8.
    """
    shown = {text: _middle(image) for text, image in images.items()}
    # Small ones are enlarged, so that the texts find room; pixels stay whole.
    sizes = next(iter(shown.values())).shape[:2]
    times = max(1, -(-128 // sizes[1]))
    height, width = (times * size for size in sizes)
    whole = Image.new(
        "RGB", (len(shown) * (width + _GAP) - _GAP, height + _TEXT + 2), (255, 255, 255)
    )
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(12)
    for place, (text, image) in enumerate(shown.items()):
        left = place * (width + _GAP)
        draw.text((left + 1, 0), text, fill=(0, 0, 0), font=font)
        large = Image.fromarray(image).resize((width, height), Image.Resampling.NEAREST)
        whole.paste(large, (left, _TEXT + 2))
    return np.asarray(whole)


def _middle(image: Tensor) -> np.ndarray:
    """Return the middle of an image (3, H, W) as (h, w, 3), uint8."""
    top, left = (max(size - _WIDEST, 0) // 2 for size in image.shape[-2:])
    cut = image[:, top : top + _WIDEST, left : left + _WIDEST]
    return (cut.permute(1, 2, 0) * 255.0).round().clamp(0, 255).to(torch.uint8).numpy()


class PhotographTable(lightning.Callback):
    """Writes `test_photographs.csv`, a row of scores for each test photograph and view.

    Every judge has a table of its own besides, such as `test_wave_photographs.csv`.
    `dolens compare` pairs runs by these tables.  A camera that is judged as built has
    `made_lenses.csv`, a row for each lens, and `made_crops.csv`, one for each crop of each lens.

    Args:
        folder: the run folder.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the tables."""
        for name, scores in getattr(pl_module, "test_scores", {}).items():
            write_table(self.folder / table_name(name), scores.rows())
        made = getattr(pl_module, "made_scores", None)
        if made is not None:
            write_table(self.folder / "made_lenses.csv", made.rows(), digits=7)
            rows = [row for found in (made, *pl_module.made_front) for row in found.crop_rows()]
            write_table(self.folder / "made_crops.csv", rows, digits=7)
