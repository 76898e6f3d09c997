"""A restorer is trained for any lens: by photographs and drawn textures through random lenses."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import interpolate
from torch.utils.data import DataLoader, Dataset

from dolens.errors import InputError, check_count
from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.data.crop_loading import ResumableSampler
from dolens.experiments.data.package_photographs import PackagePhotographsDataModule
from dolens.experiments.data.pretraining_photographs import (
    PRETRAINING_MANIFEST,
    pretraining_photographs,
)
from dolens.experiments.experiment import EXACT, MIXED, Experiment
from dolens.experiments.pretraining.random_cameras import function_bank
from dolens.experiments.pretraining.random_pupils import Draw
from dolens.reconstruction.general import GeneralRestoration, Prepared, prepared
from dolens.reconstruction.wiener import transfer_function
from dolens.sensor.colour import PATTERNS, linear_to_srgb, srgb_to_linear
from dolens.sensor.readout import Readout


class Example(NamedTuple):
    """A batch of what the network is given, and of what it shall return.

    Attributes:
        given: see `Prepared`.
        truth: sRGB, (B, 3, H, W).
    """

    given: Prepared
    truth: Tensor


@dataclass(frozen=True)
class Draws:
    """How examples are drawn; shares are of cameras.

    Attributes:
        cameras: in a batch.
        crops: of photographs that each of them images.
        side: of a crop, pixels.
        light: least and most electrons in white; their logarithm is uniform.
        read_noise: the most electrons.
        own_depth: share that is told the one function of the image's own depth.
        wrong: share of the others whose image is of a neighbouring depth that it is not told.
        bayer: share with colour filters.
        dimming: least factor on a photograph's light.
        scale: most pixels of a photograph along the side of one of a crop; log-uniform from 1.
    """

    cameras: int = 4
    crops: int = 2
    side: int = 128
    light: tuple[float, float] = (8.0, 12000.0)
    read_noise: float = 10.0
    own_depth: float = 0.4
    wrong: float = 0.15
    bayer: float = 0.12
    dimming: float = 0.5
    scale: float = 2.0


class Examples(Dataset[Example]):
    """Batches without end, each of which follows from its number and a seed alone.

    Args:
        photographs: sRGB, (3, H, W) uint8 each, sides of at least `draws.side` + K - 1 pixels or
            smaller ones, which are mirrored to that size.
        weights: how often each is drawn.
        functions: point spread functions of N cameras at D depths, (N, D, 3, K, K).
        draws: how they are drawn.
        seed: of all of them.
    """

    def __init__(
        self,
        photographs: Sequence[Tensor],
        weights: Sequence[float],
        functions: Tensor,
        draws: Draws,
        seed: int,
    ) -> None:
        self.margin = functions.shape[-1] // 2
        least = draws.side + 2 * self.margin
        self.photographs = [_at_least(photograph, least) for photograph in photographs]
        self.weights = torch.tensor(weights, dtype=torch.float64)
        self.functions, self.draws = functions, draws
        self.seed = seed

    def __getitem__(self, number: int) -> Example:
        """Return the batch of a number."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + number)
        made = [self._camera(generator) for _ in range(self.draws.cameras)]
        given = [one.given for one in made]
        return Example(
            Prepared(*(torch.cat(parts) for parts in zip(*given, strict=True))),
            torch.cat([one.truth for one in made]),
        )

    def _camera(self, generator: torch.Generator) -> Example:
        """Return the crops of one camera."""
        draw, draws = Draw(generator), self.draws
        chosen = int(torch.randint(len(self.functions), (), generator=generator))
        functions = self.functions[chosen].float()
        functions = functions / functions.sum(dim=(-2, -1), keepdim=True)  # of half precision
        turns = int(torch.randint(4, (), generator=generator))
        functions = functions.rot90(turns, (-2, -1))
        if draw.chance(0.5):
            functions = functions.flip(-1)
        functions = functions[:, torch.randperm(3, generator=generator)]
        depth = int(torch.randint(len(functions), (), generator=generator))
        told = functions
        if draw.chance(draws.own_depth):
            told = functions[depth : depth + 1]
        elif draw.chance(draws.wrong):
            told = torch.cat([functions[:depth], functions[depth + 1 :]])

        light = draw.log_uniform(*draws.light)
        # Half of the cameras read quietly, as sensors of today do.
        read = draws.read_noise * draw.uniform() ** 2
        scenes = torch.stack([self._scene(generator) for _ in range(draws.crops)])
        image = blurred(scenes, functions[depth])
        side, margin = draws.side, self.margin
        inner = slice(margin, margin + side)
        pattern = draw.one_of(list(PATTERNS)) if draw.chance(draws.bayer) else None
        well = max(light, 1000.0)
        readout = Readout.at_light(light, well, read_noise=read / well, pattern=pattern)
        raw = readout.develop(readout(image[..., inner, inner].clamp(min=0.0), generator))
        truth = linear_to_srgb(scenes[..., inner, inner])
        return Example(prepared(raw, told, torch.tensor(readout.noise)), truth)

    def _scene(self, generator: torch.Generator) -> Tensor:
        """Return linear light of a crop with its margins, (3, S, S)."""
        draw = Draw(generator)
        number = int(torch.multinomial(self.weights, 1, generator=generator))
        photograph = self.photographs[number]
        size = self.draws.side + 2 * self.margin
        most = min(self.draws.scale, min(photograph.shape[-2:]) / size)
        cut = int(size * draw.log_uniform(1.0, most))

        def place(length: int) -> int:
            return int(torch.randint(length - cut + 1, (), generator=generator))

        y, x = place(photograph.shape[-2]), place(photograph.shape[-1])
        crop = srgb_to_linear(photograph[:, y : y + cut, x : x + cut].float() / 255.0)
        if cut > size:
            crop = interpolate(crop[None], (size, size), mode="bilinear", antialias=True)[0]
        crop = crop.rot90(int(torch.randint(4, (), generator=generator)), (-2, -1))
        if draw.chance(0.5):
            crop = crop.flip(-1)
        if draw.chance(0.3):
            crop = crop[torch.randperm(3, generator=generator)]
        least = self.draws.dimming
        return (least + (1.0 - least) * math.sqrt(draw.uniform())) * crop


def blurred(scenes: Tensor, functions: Tensor) -> Tensor:
    """Return scenes (B, 3, S, S) blurred by (3, K, K); K // 2 pixels at each edge are wrong."""
    size = scenes.shape[-1]
    transfer = transfer_function(functions, size, size)
    return torch.fft.irfft2(torch.fft.rfft2(scenes) * transfer, s=(size, size))


def _at_least(photograph: Tensor, side: int) -> Tensor:
    """Return a photograph continued by its mirror image where it is smaller."""
    while min(photograph.shape[-2:]) < side:
        for axis in (-2, -1):
            if photograph.shape[axis] < side:
                photograph = torch.cat([photograph, photograph.flip(axis)], dim=axis)
    return photograph


# Of a mean squared error: nothing is asked of pictures beyond 60 dB.
_LEAST_ERROR = 1e-6


class PretrainingModule(CameraModule):
    """Trains one network for all lenses; a camera that it has not seen judges it.

    Batches are those of `Examples`, and the lens's variables stay.  The loss is the mean of
    10·log10 of each picture's mean squared error, so that it is the score itself: a picture that is
    hard to restore counts no more than others.

    Args:
        **camera: the arguments of `CameraModule`, which validates and tests.

    Raises:
        InputError: the network is none for any lens, or the camera has variables.
    """

    precisions = (EXACT, MIXED)

    def __init__(self, **camera: Any) -> None:
        super().__init__(**camera)
        if not isinstance(self.network, GeneralRestoration):
            raise InputError(
                f"network: {type(self.network).__name__}; allowed for pretraining: general"
            )
        if len(self.variables):
            raise InputError("variables: allowed for pretraining: null, the camera only judges")

    def check_trainer(self, trainer: lightning.Trainer) -> None:
        """Refuse what a camera could share: batches are made whole; see `Experiment`."""
        Experiment.check_trainer(self, trainer)

    def training_step(self, batch: Example, batch_idx: int) -> Tensor:
        """Restore pictures of random lenses and sensors, and compare them with the truth."""
        with self.costs.making_images():  # workers have made them
            given = Prepared(*batch.given)
        restored = self.network.restored(given).float()
        error = (restored - batch.truth).square().mean(dim=(1, 2, 3))
        loss = 10.0 * (error + _LEAST_ERROR).log10().mean()
        self.log("train/loss", loss, prog_bar=True)
        self.log("train/psnr_db", -loss.detach(), prog_bar=True)
        return loss


_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&%?!"


def dead_leaves(generator: np.random.Generator, side: int) -> Tensor:
    """Return discs that cover each other, with radii r of density ∝ r⁻³ as in natural images.

    Lee, Mumford and Huang, Int. J. Comput. Vis. 41, 35 (2001).

    Args:
        generator: source of randomness.
        side: of the picture, pixels.

    Returns:
        (3, side, side) uint8, sRGB.
    """
    spread = _spread(generator)
    image = Image.new("RGB", (2 * side, 2 * side), _colour(generator, spread))
    draw = ImageDraw.Draw(image)
    smallest, largest = 4.0, side / 1.5
    for share in generator.random(3000):
        # The distribution function of r⁻³ between both ends, inverted.
        radius = (smallest**-2 - share * (smallest**-2 - largest**-2)) ** -0.5
        x, y = generator.uniform(-radius, 2 * side + radius, 2)
        box = (x - radius, y - radius, x + radius, y + radius)
        if generator.random() < 0.5:
            draw.ellipse(box, fill=_colour(generator, spread))
        else:
            angles = np.sort(generator.uniform(0.0, 2.0 * np.pi, 5))
            corners = [(x + radius * np.cos(a), y + radius * np.sin(a)) for a in angles]
            draw.polygon(corners, fill=_colour(generator, spread))
    return _halved(image)


def text(generator: np.random.Generator, side: int) -> Tensor:
    """Return lines of random letters of several sizes on a shaded ground; see `dead_leaves`."""
    ground = np.linspace(0.0, 1.0, 2 * side)[:, None, None]
    spread = _spread(generator)
    first, last = (np.array(_colour(generator, spread)) for _ in range(2))
    shaded = np.broadcast_to(first + (last - first) * ground, (2 * side, 2 * side, 3))
    image = Image.fromarray(shaded.round().astype(np.uint8))
    draw = ImageDraw.Draw(image)
    y = 0.0
    while y < 2 * side:
        size = float(generator.uniform(14.0, 80.0))
        line = "".join(generator.choice(list(_LETTERS + "    "), 80))
        x = float(generator.uniform(-40.0, 20.0))
        draw.text((x, y), line, _colour(generator, spread), ImageFont.load_default(size))
        y += 1.2 * size
    return _halved(image)


def _spread(generator: np.random.Generator) -> float:
    # Of a picture's colours about grey: of most surfaces, or of paint and charts.
    return 35.0 if generator.random() < 0.6 else 120.0


def _colour(generator: np.random.Generator, spread: float) -> tuple[int, ...]:
    values = generator.uniform(0.0, 255.0) + generator.normal(0.0, spread, 3)
    return tuple(int(value) for value in values.clip(0, 255))


def _halved(image: Image.Image) -> Tensor:
    small = image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX)
    return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous()


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
