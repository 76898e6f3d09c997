"""Images of one lens that does not change, made once, so that networks alone are compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from hydra.utils import instantiate
from torch import Tensor

from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.views.base import seed_of
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from dolens.reconstruction import Restoration
from dolens.scene.planar import pinhole_image
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.readout import Readout
from scripts.composed import composed

_NOISE = 7919  # apart from the seeds of rendering


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
        camera = instantiate(cfg.module)(lens=build_lens(RunSettings.of(cfg)))
        data = instantiate(cfg.data)
    if not file.is_file():
        data.setup(None)
        names = ("train", "validation", "test") if training else ("test",)
        made = {name: vars(_made(camera, data, name)) for name in names}
        functions = camera.views.point_spread_functions(camera.lens, camera.variables())
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
    views, values = camera.views, camera.variables()
    renderer = views.renderer if split == "train" else views.evaluation_renderer
    images, truths = [], []
    for number, textures in enumerate(loaders[split]()):
        seed = seed_of(views.seed, stage, number)
        image = renderer.render(camera.lens, views.scene, textures, seed, values)
        truth = linear_to_srgb(pinhole_image(views.scene.colours(textures), views.sensor))
        images.append(image.half())
        truths.append(truth.half())
    names = [] if split == "train" else data.evaluation_photographs(split)
    return Split(torch.cat(images), torch.cat(truths), names)
