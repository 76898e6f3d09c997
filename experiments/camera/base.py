"""A camera: a lens, the way it looks at a scene, and the network that restores its images."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.experiments.camera.reconstruction import (
    Loss,
    check_reconstruction,
    evaluating,
    loss_over_views,
    restoration_of,
)
from dolens.experiments.camera.views.base import Comparison, Imaging, Shot, Views
from dolens.experiments.experiment import Experiment
from dolens.optics.lens import Lens
from dolens.optimize.variables import DesignVariables
from dolens.reconstruction.processes import processes
from dolens.sensor.noise import BatchShare


class Camera(Experiment):
    """Images textures through a lens and a sensor, restores them, and compares them with the truth.

    Args:
        lens: the lens; its other parameters than the variables stay as they are.
        views: image the textures.
        network: restores the images; see `restoration_of`.
        loss: compares restored and true images; see `loss_terms`.
        variables: settings of `DesignVariables`.
        view_norm: p of the power mean that joins the views' losses; see `loss_over_views`.

    Raises:
        InputError: a setting is out of range, or the network or the loss does not fit.
    """

    def __init__(
        self,
        lens: Lens,
        views: Imaging,
        network: nn.Module,
        loss: Loss,
        variables: Mapping[str, Mapping[str, Any] | None],
        view_norm: float,
    ) -> None:
        super().__init__(lens)
        self.variables = DesignVariables(lens, variables)
        self.variables.write_to(self.lens)
        self.network = restoration_of(network)
        self.loss = loss
        self.views = views
        if not view_norm >= 1.0:
            raise InputError(f"view_norm must be at least 1, not {view_norm}")
        self.view_norm = view_norm
        if views.readouts and not self.network.takes_readouts:
            raise InputError(
                f"exposures: {type(self.network).__name__} takes one readout; allowed: "
                "network=general, wiener_tv, wiener_bm3d, or exposures.readouts=one"
            )
        size = (views.sensor.height, views.sensor.width)
        functions = 1 if self.knows_places else len(views.psf_labels()) // (views.readouts or 1)
        images = 1 if self.knows_places else None
        check_reconstruction(self.network, self.loss, size, functions, images, views.readouts)

    @property
    def knows_places(self) -> bool:
        """Return whether the network is given the functions of each image's own place."""
        return self.network.takes_functions_of_images and self.views.view_is_known

    def restore(self, taken: Views, functions: Tensor | None) -> Tensor:
        """Return restored images (B, V, 3, H, W), display-encoded.

        Args:
            taken: what the sensor gave.
            functions: point spread functions, or None where the network asks for none.
        """
        field = None if taken.field is None else taken.field.flatten(0, 1)
        restored = self.network(taken.given, functions, field, *self.noise())
        # Under autocast a network may end in half precision, in which nothing is to be compared.
        restored = restored.to(self.network.dtype)
        return restored.unflatten(0, taken.raw.shape[:2])

    def noise(self) -> list[Tensor]:
        """Return the noise of the sensor, (2,) or (N, 2) of readouts, in a list; none where the
        network asks for none.
        """
        return self.network.noise_arguments(self.views.noise)

    def filtered(self, taken: Views, functions: Tensor | None) -> Tensor | None:
        """Return pictures (B, V, 3, H, W) by the network's linear filter alone, display-encoded.

        None where it has none: what a network of one's own adds to its filter is then not known.
        """
        alone = getattr(self.network, "filtered", None)
        if alone is None or functions is None:
            return None
        pictures = alone(taken.raw.flatten(0, 1), functions)
        return pictures.unflatten(0, taken.raw.shape[:2])

    def loss_over_views(
        self, restored: Tensor, truth: Tensor, shared: bool = False
    ) -> dict[str, Tensor]:
        """Return the loss and its terms for images (B, V, 3, H, W).

        Where they are shared, the loss is that of all processes' images together.
        """
        return loss_over_views(self.loss, restored, truth, self.view_norm, shared)

    def take(self, values: Mapping[str, Tensor], shot: Shot) -> tuple[Views, Tensor | None]:
        """Image textures, and find point spread functions where the network asks for them.

        Both are computed in the lens's own precision, whatever the trainer's is.

        Args:
            values: the lens's variables.
            shot: the textures, and what decides the random numbers.
        """
        with self.exact():
            taken = self.views.take(self.lens.with_values(values), shot)
            return taken, self.functions(values, taken, shot.stage)

    def share_of_step(self, count: int, batch_idx: int) -> BatchShare | None:
        """Return which images of a step's batch these are: of all processes, and of all batches
        whose gradients are accumulated; None where they are all of it.
        """
        parts = self.trainer.accumulate_grad_batches
        total = parts * self.trainer.world_size * count
        number = batch_idx % parts * self.trainer.world_size + self.trainer.global_rank
        return None if total == count else BatchShare(number * count, total)

    def evaluation_batch(self, stage: str, batch_idx: int) -> int:
        """Return the number of an evaluation batch among those of all processes.

        Args:
            stage: `val` or `test`.
            batch_idx: its number among those of this process.
        """
        if processes() == 1:
            return batch_idx
        split = {"val": "validation", "test": "test"}[stage]
        return self.trainer.datamodule.evaluation_batches(split)[batch_idx]

    def exact(self) -> AbstractContextManager:
        """Compute without autocast within: optics and measures are never in half precision."""
        return torch.autocast(self.device.type, enabled=False)

    def functions(self, values: Mapping[str, Tensor], taken: Views, stage: str) -> Tensor | None:
        """Return what the network is told of images: functions (views, 3, K, K) of all of them, or
        (B·V, D, 3, K, K), of each its own; None if it asks for none.

        Args:
            values: the lens's variables.
            taken: the images.
            stage: that they were taken in.
        """
        if not self.network.needs_point_spread_function:
            return None
        own, lens = None, self.lens.with_values(values)
        if self.network.takes_functions_of_images:
            own = self.views.functions_of_images(lens, taken, stage)
        return self.views.point_spread_functions(lens) if own is None else own

    def comparison(self) -> Comparison | None:
        """Return the loss as a function of images, for a renderer that compares gradients.

        It is None where no variable of the lens is trained.
        """
        if not len(self.variables):
            return None

        def loss(taken: Views, values: Mapping[str, Tensor]) -> Tensor:
            functions = self.functions(values, taken, "train")
            # No statistics or dropout of its own may move while gradients are compared.
            with evaluating(self.network):
                restored = self.restore(taken, functions)
            return self.loss_over_views(restored, taken.truth.to(restored.dtype))["total"]

        return Comparison([self.variables.scaled], self.variables, loss)

    def identity(self) -> dict[str, Any]:
        """Return the experiment, the lens, the variables' names and the network's shapes."""
        return {
            **super().identity(),
            "variables": list(self.variables.names),
            "network": ", ".join(f"{n} {tuple(p.shape)}" for n, p in _shapes(self.network)),
        }


def _shapes(module: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """Return the first and last parameters, which tell networks of other widths or kinds apart."""
    parameters = list(module.named_parameters())
    return iter([parameters[0], parameters[-1]]) if parameters else iter([])
