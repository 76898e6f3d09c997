"""Networks behind one lens that does not change: its images are made once, and each network is
trained on them for seconds of one processor.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from hydra.utils import instantiate
from torch import Tensor

from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.photograph_scores import scores_by_photograph
from dolens.experiments.camera.reconstruction import loss_over_views
from dolens.experiments.camera.views.base import seed_of
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_module
from dolens.reconstruction import (
    FeatureWienerRestoration,
    Restoration,
    RestorationLoss,
    psnr_db,
)
from dolens.reconstruction.feature_wiener import NOISE_TO_SIGNAL
from dolens.reconstruction.opponent_wiener import OpponentWiener
from dolens.scene.planar import pinhole_image
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.readout import Readout
from scripts.composed import composed

_NOISE = 7919  # apart from the seeds of rendering
_DEPTHS, _MARGIN = 3, 32  # of the network that is told the depth
_VIEW_NORM = 4.0  # as conf/wavefront_camera.yaml
_BETAS = (0.9, 0.99)  # as conf/optimizer/camera.yaml
_RATE = 0.002  # as conf/wavefront_camera.yaml
_TEST_SEED = 10**6
_TIMED = 3  # steps whose time tells how many are possible


@dataclass(frozen=True)
class Split:
    """Images of one split.

    Attributes:
        images: without noise, linear light, (N, D, 3, H, W), half precision.
        truth: sRGB-encoded, (N, 3, H, W), half precision.
        photographs: of each of the N crops, its photograph; none for training.
    """

    images: Tensor
    truth: Tensor
    photographs: list[str]


@dataclass(frozen=True)
class FixedOptics:
    """What a lens makes of photographs.

    Attributes:
        functions: point spread functions that networks are given, (D, 3, K, K).
        readout: the sensor's electronics.
        splits: by name: train, validation, test.
        batch: crops of a training batch.
    """

    functions: Tensor
    readout: Readout
    splits: dict[str, Split]
    batch: int

    def raw(self, images: Tensor, seed: int) -> Tensor:
        """Return images in linear light, read out with the noise of a seed and developed."""
        generator = torch.Generator().manual_seed(seed + _NOISE)
        return self.readout.develop(self.readout(images.float(), generator))


@torch.no_grad()
def fixed_optics(file: Path, overrides: Sequence[str], training: bool = True) -> FixedOptics:
    """Return the images of an experiment's lens as it begins; they are kept in a file.

    Args:
        file: read where it exists; written where not.
        overrides: of `train.py`, `experiment=` among them; `data.steps_per_epoch` training batches
            are made.
        training: whether training and validation images are made too, or test images alone.
    """
    with composed(overrides) as cfg:
        camera = build_module(RunSettings.of(cfg))
        data = instantiate(cfg.data)
    if not file.is_file():
        data.setup(None)
        names = ("train", "validation", "test") if training else ("test",)
        made = {name: vars(_made(camera, data, name)) for name in names}
        lens = camera.lens.with_values(camera.variables())
        functions = camera.views.point_spread_functions(lens)
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.save({"functions": functions, "splits": made}, file)
    kept = torch.load(file, weights_only=True)
    splits = {name: Split(**tensors) for name, tensors in kept["splits"].items()}
    return FixedOptics(kept["functions"], camera.views.readout, splits, data.batch_size)


def composed_network(overrides: Sequence[str]) -> Restoration:
    """Return the network that `train.py` would make, of new weights."""
    with composed(overrides) as cfg:
        return instantiate(cfg.network)


def _made(camera: Camera, data: CropDataModule, split: str) -> Split:
    loaders = {
        "train": data.train_dataloader,
        "validation": data.val_dataloader,
        "test": data.test_dataloader,
    }
    stage = {"validation": "val"}.get(split, split)
    views, lens = camera.views, camera.lens.with_values(camera.variables())
    renderer = views.renderer if split == "train" else views.evaluation_renderer
    images, truths = [], []
    for number, textures in enumerate(loaders[split]()):
        seed = seed_of(views.seed, stage, number)
        image = renderer.render(lens, views.scene, textures, seed)
        truth = linear_to_srgb(pinhole_image(views.scene.colours(textures), views.sensor))
        images.append(image.half())
        truths.append(truth.half())
    names = [] if split == "train" else data.evaluation_photographs(split)
    return Split(torch.cat(images), torch.cat(truths), names)


class _KnownDepth(OpponentWiener):
    def forward(self, image: Tensor, functions: Tensor | None) -> Tensor:
        """Return the picture by the filter of the image's depth; images go around the depths."""
        pictures = super().forward(image, functions)[:, 1:]
        numbers = torch.arange(len(image))
        return pictures[numbers, numbers % self.depths][:, None]


def known_depth() -> FeatureWienerRestoration:
    """Return `network=feature_wiener` with the filter of the depth that each image has."""
    network = FeatureWienerRestoration(margin=_MARGIN)
    network.wiener = _KnownDepth(_MARGIN, NOISE_TO_SIGNAL, _DEPTHS)
    return network


@dataclass(frozen=True)
class TrainedFor:
    """A network that was trained.

    Attributes:
        network: in evaluation mode.
        seconds: of one processor, for all steps; images were made before.
        steps: that it took.
    """

    network: Restoration
    seconds: float
    steps: int


def train_for(
    make: Callable[[], Restoration], optics: FixedOptics, limit: float, seed: int
) -> TrainedFor:
    """Train a network for so much process time as the camera experiment does, but for the lens.

    One without parameters is taken as it is.

    The seed decides its first weights, the order of the crops and the noise.  The learning rate
    falls to zero along a cosine, over as many steps as the time is enough for by the first ones.

    Args:
        make: the network.
        optics: images that it is trained on.
        limit: process time, seconds.
        seed: of all random numbers.
    """
    torch.manual_seed(seed)
    if not [*make().parameters()]:
        return TrainedFor(make().eval(), 0.0, 0)
    trial = _Training(make().train(), optics, seed)
    trial.step(0)
    seconds = sum(trial.step(number) for number in range(_TIMED)) / _TIMED
    steps = max(1, round(limit / seconds))
    torch.manual_seed(seed)
    training = _Training(make().train(), optics, seed)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(training.optimizer, T_max=steps)
    taken = 0.0
    for number in range(steps):
        taken += training.step(number)
        scheduler.step()
    return TrainedFor(training.network.eval(), taken, steps)


class _Training:
    """A network, its optimizer, and the images that it sees."""

    def __init__(self, network: Restoration, optics: FixedOptics, seed: int) -> None:
        self.network, self.optics, self.seed = network, optics, seed
        self.loss = RestorationLoss(perceptual="none")
        self.optimizer = torch.optim.Adam(network.parameters(), lr=_RATE, betas=_BETAS)
        self.generator = torch.Generator().manual_seed(seed)
        self.order: list[int] = []

    def step(self, number: int) -> float:
        """Take a step, and return its process time in seconds; noise and images do not count."""
        train = self.optics.splits["train"]
        chosen = torch.tensor([self._next() for _ in range(self.optics.batch)])
        truth = train.truth[chosen].float()
        raw = self.optics.raw(train.images[chosen], self.seed * 100_000 + number)
        started = time.process_time()
        found = self.network(raw.flatten(0, 1), self.optics.functions, None)
        found = found.unflatten(0, raw.shape[:2])
        truth = truth[:, None].expand_as(found)
        total = loss_over_views(self.loss, found, truth, _VIEW_NORM)["total"]
        self.optimizer.zero_grad()
        total.backward()
        self.optimizer.step()
        return time.process_time() - started

    def _next(self) -> int:
        # All crops before any comes again.
        if not self.order:
            count = len(self.optics.splits["train"].images)
            self.order = torch.randperm(count, generator=self.generator).tolist()
        return self.order.pop()


@torch.no_grad()
def scores(network: Restoration, optics: FixedOptics, split: str) -> Tensor:
    """Return the PSNR in dB of every photograph at every depth, (P, D)."""
    chosen = optics.splits[split]
    noise = network.noise_arguments(optics.readout.noise)
    crops = []
    for number, (images, truth) in enumerate(zip(chosen.images, chosen.truth, strict=True)):
        raw = optics.raw(images, _TEST_SEED + number)
        found = network(raw, optics.functions, None, *noise).clamp(0.0, 1.0)
        crops.append(psnr_db(found, truth.float().expand_as(found)))
    found = scores_by_photograph({"psnr_db": torch.stack(crops)}, chosen.photographs, ())
    return found.metrics["psnr_db"]
