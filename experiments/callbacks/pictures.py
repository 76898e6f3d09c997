"""Pictures of a camera while it trains and when it has been tested."""

import copy
from pathlib import Path

import lightning
import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.plotting import (
    comparison_figure,
    layout_figure,
    psf_figure,
    save_figure,
)
from dolens.reconstruction import psnr_db
from experiments.callbacks.figures import log_figure
from experiments.camera.camera import CameraModule


class CameraPictures(lightning.Callback):
    """Truth, raw and restored images, point spread functions and the layout.

    To TensorBoard every few epochs, from the first validation crops; and as PNG files from the
    first test crops when the test ends.

    Args:
        folder: where PNG files go; made when needed.
        every_n_epochs: how often pictures are logged.
    """

    def __init__(self, folder: str, every_n_epochs: int = 1) -> None:
        self.folder = Path(folder)
        self.every_n_epochs = every_n_epochs
        self._batches: dict[str, Tensor] = {}

    def on_validation_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Tensor,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the first crop."""
        if batch_idx == 0:
            self._batches["val"] = batch[:1]

    def on_test_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Tensor,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the first crop."""
        if batch_idx == 0:
            self._batches["test"] = batch[:1]

    def on_validation_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Log pictures every few epochs, and after the last one."""
        last = trainer.current_epoch + 1 == trainer.max_epochs
        if trainer.sanity_checking or not (
            last or trainer.current_epoch % self.every_n_epochs == 0
        ):
            return
        for name, figure in camera_figures(pl_module, self._batches["val"], "val").items():
            log_figure(trainer, name, figure)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the PNG files."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, figure in camera_figures(pl_module, self._batches["test"], "test").items():
            save_figure(figure, self.folder / f"{name}.png")
            log_figure(trainer, f"test_{name}", figure)


@torch.no_grad()
def camera_figures(module: CameraModule, textures: Tensor, stage: str) -> dict[str, Figure]:
    """Figures of a camera by name: images, point_spread_functions, layout."""
    views = module.views
    # Evaluation mode: the picture shows the network as it is measured, and leaves its statistics.
    training = module.network.training
    module.network.eval()
    truth, raw, restored = (x.cpu()[0] for x in module.evaluation_images(textures, stage, 0))
    module.network.train(training)
    functions = views.point_spread_functions(module.lens, module.variables(), 96).detach()
    quality = {
        "raw": psnr_db(raw, truth).tolist(),
        "restored": psnr_db(restored, truth).tolist(),
    }
    return {
        "images": comparison_figure(truth, raw, restored, views.labels(), quality),
        "point_spread_functions": psf_figure(
            functions.cpu(),
            views.psf_labels(),
            views.sensor.pixel_pitch,
            "Point spread functions",
        ),
        "layout": layout_figure(
            copy.deepcopy(module.lens).cpu(),
            object_distance=views.object_distance,
            title=module.lens.name,
        ),
    }
