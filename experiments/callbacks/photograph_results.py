"""Photographs of a validation are logged as pictures, those of a test are written as a page and
their scores as tables.
"""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import lightning
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dolens.errors import InputError, check_count
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.camera_figures import view_name
from dolens.experiments.camera.photograph_scores import table_name
from dolens.experiments.data.photographs import shown_name
from dolens.experiments.loggers.protocol import TakesPictures
from dolens.experiments.tables import write_table
from dolens.photograph_page.page import PAGE, PhotographPage, ShownPhotograph, shown_scores
from dolens.reconstruction import psnr_db
from dolens.reconstruction.processes import gathered
from dolens.reconstruction.quality import scores_of
from dolens.sensor.colour import linear_to_srgb

logger = logging.getLogger(__name__)

_GAP, _TEXT = 4, 15  # pixels between pictures, and of the line of text above them
# Wider pictures are cut to their middle: a log is no archive.
_WIDEST = 256


class ChosenCrops(lightning.Callback):
    """Looks at the first crops of some photographs, spread over all of a stage."""

    def __init__(self, photographs: int) -> None:
        self.photographs = photographs
        self._crops: dict[int, str] = {}

    def _choose(self, names: Sequence[str]) -> None:
        """Choose the crops, which have the names of their photographs."""
        first: dict[str, int] = {}
        for crop, name in enumerate(names):
            first.setdefault(name, crop)
        found = list(first)
        count = min(self.photographs, len(found))
        chosen = [found[(2 * n + 1) * len(found) // (2 * count)] for n in range(count)]
        self._crops = {first[name]: name for name in chosen}

    def seen(
        self, trainer: lightning.Trainer, camera: Camera, stage: str, batch: Tensor, index: int
    ) -> Iterator[tuple[int, str, str, tuple[Tensor, Tensor, Tensor]]]:
        """Yield number, photograph, view and images of the chosen crops in a batch.

        The images are truth, sensor's image and restored image, (3, H, W), display-encoded.
        """
        number = camera.evaluation_batch(stage, index)
        first = number * getattr(trainer.datamodule, "batch_size", len(batch))
        chosen = {n: self._crops[first + n] for n in range(len(batch)) if first + n in self._crops}
        seen = getattr(camera, "seen", None)
        if not chosen or seen is None:
            return
        taken, restored = seen
        images = (taken.truth, linear_to_srgb(taken.raw), restored.clamp(0.0, 1.0))
        for crop, photograph in chosen.items():
            for view, label in enumerate(camera.views.labels()):
                truth, raw, found = (image[crop, view].float().cpu() for image in images)
                yield first + crop, shown_name(photograph), label, (truth, raw, found)


class ValidationPictures(ChosenCrops):
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
        super().__init__(photographs)
        self.times = times
        self._found: list[_Picture] = []

    def on_validation_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Choose the crops, if it is time for pictures."""
        self._crops, self._found = {}, []
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        kept = any(isinstance(entry, TakesPictures) for entry in trainer.loggers)
        if find is not None and kept and not trainer.sanity_checking and self._due(trainer):
            self._choose(find("validation"))

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
        if not isinstance(pl_module, Camera):
            return
        for crop, photograph, view, images in self.seen(
            trainer, pl_module, "val", batch, batch_idx
        ):
            self._found.append(_picture(crop, f"{photograph}/{view}", *images))

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


class PhotographsPage(ChosenCrops):
    """Writes `photographs.html`: truth, sensor's image and restored image of some test photographs,
    with a slider between any two of them, a magnifier and their scores.

    Each is shown by its first crop, in every view, with the noise with which the test measures it.

    Args:
        folder: the run folder.
        photographs: how many, spread over those of the test; 0: no page.

    Raises:
        InputError: a negative number.
    """

    def __init__(self, folder: str, photographs: int = 6) -> None:
        check_count("callbacks.photographs_page: photographs", photographs, 0)
        super().__init__(photographs)
        self.folder = Path(folder)
        self._found: list[tuple[int, ShownPhotograph]] = []

    def on_test_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Choose the crops; where the data name no photographs, the first ones."""
        self._crops, self._found = {}, []
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        if self.photographs and isinstance(pl_module, Camera):
            numbers = [f"photograph {number + 1}" for number in range(self.photographs)]
            self._choose(numbers if find is None else find("test"))

    def on_test_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: object,
        batch: Tensor,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the images of the chosen crops in this batch."""
        if not isinstance(pl_module, Camera):
            return
        for crop, photograph, view, (truth, raw, restored) in self.seen(
            trainer, pl_module, "test", batch, batch_idx
        ):
            scores = scores_of(raw, truth, "raw_") | scores_of(restored, truth)
            images = {"truth": truth, "sensor": raw, "restored": restored}
            name = f"{photograph}, {view_name(view)}"
            self._found.append((crop, ShownPhotograph(name, images, shown_scores(scores))))

    def on_test_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Write the page, with photographs that other processes measured too."""
        parts, self._found = gathered(self._found), []
        found = {(crop, entry.name): entry for part in parts for crop, entry in part}
        if not found or not trainer.is_global_zero:
            return
        page = PhotographPage(len(found))
        for _, entry in sorted(found.items(), key=lambda item: item[0][0]):
            page.add(entry)
        title = f"Test photographs of {getattr(pl_module, 'experiment', '') or 'a camera'}"
        note = "Each is one crop of the sensor's size, and so are its scores; truth is the scene."
        try:
            page.write(self.folder / PAGE, title, [note])
        except OSError as problem:  # the test's numbers are not to be lost with it
            logger.error("No %s: %s", PAGE, problem)


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
