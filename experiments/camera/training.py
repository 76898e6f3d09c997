"""Settings and parts of a camera's training: parameter groups, discriminators, costs of steps."""

import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.experiments.camera.as_built import Manufacture
from dolens.experiments.camera.evaluation import gain_numbers
from dolens.experiments.camera.lens_optimizer import variable_numbers
from dolens.experiments.camera.made_lenses import front_numbers
from dolens.experiments.camera.reconstruction import Loss
from dolens.experiments.settings import check_positive
from dolens.reconstruction import RelativisticDiscriminators, Restoration
from dolens.reconstruction.processes import average_gradients, mean_over_processes


@dataclass(frozen=True)
class Reconstruction:
    """The network that restores images, and what restored images are judged by.

    Attributes:
        network: a `Restoration`, or any module that maps display-encoded images (B, 3, H, W) to
            such images.
        loss: compares restored and true images (B, 3, H, W), display-encoded, by a number or by a
            mapping with the number as `total`.
        view_norm: p of the power mean that joins the views' losses; see `loss_over_views`.
        discriminator: judges the restored images besides; None for no adversarial term.
        compiled: whether `torch.compile` makes the network that is trained; its weights keep their
            names.
    """

    network: nn.Module
    loss: Loss
    view_norm: float
    discriminator: RelativisticDiscriminators | None
    # Run folders of old lack it.
    compiled: bool = False


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the parts of a camera.

    Attributes:
        optics: of the lens's variables, where its optimizer takes steps with the network's.
        network: of the network.
        discriminator: of the discriminators; None: the network's.
        fine_tuning: of a network whose weights restore already; None: the network's.

    Raises:
        InputError: a rate that is not positive.
    """

    optics: float
    network: float
    discriminator: float | None
    # Run folders of old lack it.
    fine_tuning: float | None = None

    def __post_init__(self) -> None:
        for key, rate in vars(self).items():
            if key in ("optics", "network") or rate is not None:
                check_positive(f"learning_rates.{key}", rate)

    def of(self, network: Restoration) -> "LearningRates":
        """Return those with the rate that a network is to have as `network`."""
        if self.fine_tuning is None or not network.restores_already:
            return self
        return replace(self, network=self.fine_tuning)


@dataclass(frozen=True)
class Training:
    """Settings of how the parameters of a camera move.

    Attributes:
        optimizer: parameter groups → optimizer; a `CameraOptimizer` may move the lens apart.
        learning_rates: of the groups.
        scheduler: optimizer → scheduler, stepped once a training step; or None.
    """

    optimizer: Callable[..., torch.optim.Optimizer]
    learning_rates: LearningRates
    scheduler: Callable[..., Any] | None


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


def check_sharing(
    trainer: lightning.Trainer, adversary: Adversary | None, manufacture: Manufacture | None
) -> None:
    """Refuse what discriminators and lenses that are made cannot share.

    Args:
        trainer: of the run.
        adversary: makes a step for every batch.
        manufacture: makes lenses in one process.

    Raises:
        InputError: the line names the setting.
    """
    batches = trainer.accumulate_grad_batches
    if batches > 1 and adversary is not None:
        raise InputError(
            f"trainer.accumulate_grad_batches: {batches}; allowed with a discriminator: 1, as "
            "it makes a step for every batch"
        )
    if manufacture is not None and trainer.world_size > 1:
        raise InputError(
            f"trainer.devices: {trainer.world_size}; allowed with tolerances: 1, as one "
            "process makes the lenses of a step"
        )


def parameter_groups(camera: Any) -> list[dict[str, Any]]:
    """Return the optimizer's groups: the network, and the lens's variables unless they move apart.

    Args:
        camera: a `CameraModule`.
    """
    rates = camera.learning_rates
    network = {"params": list(camera.network.parameters()), "lr": rates.network, "name": "network"}
    if not len(camera.variables) or camera.lens_steps.apart:
        return [network]
    return [network, {"params": [camera.variables.scaled], "lr": rates.optics, "name": "optics"}]


def summary_numbers(camera: Any) -> dict[str, float]:
    """Return the variables, intervals of scores, and costs of a camera that was tested.

    Args:
        camera: a `CameraModule`.
    """
    numbers = {n: float(v) for n, v in variable_numbers(camera.variables()).items()}
    for stage, scores in camera.test_scores.items():
        numbers |= scores.numbers(stage) | gain_numbers(scores, stage)
    numbers["network/pretrained"] = float(camera.network.pretrained)
    if hasattr(camera.loss, "perceptual_available"):  # a loss of a user's own may know no such
        numbers["loss/perceptual_available"] = float(camera.loss.perceptual_available)
    numbers["cost/rays"] = float(camera.views.rays())
    numbers |= camera.views.numbers() | camera.evaluation.costs()
    if camera.made_scores is not None:
        numbers |= camera.made_scores.numbers() | front_numbers(camera.made_front)
    return numbers | camera.lens_steps.numbers() | camera.costs.numbers()


# Steps that medians are of, at most: a run may have any number.
_STEPS = 100_000


class StepCosts:
    """Measures the wall time of training steps.

    Waiting for data comes before a step and is no part of it.  The optics' share is the time in
    which images are made, and in the backward pass the time after the gradient has reached the
    images.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._optics: deque[float] = deque(maxlen=_STEPS)
        self.latest: dict[str, float] = {}
        self._step_started = 0.0
        self.data: float | None = None  # mean seconds of waiting for a batch, where it is measured
        self._backward_started: float | None = None

    def start(self) -> None:
        """Begin a step."""
        self._step_started = time.perf_counter()

    @contextmanager
    def making_images(self) -> Iterator[None]:
        """Count the time within as the optics'."""
        started = time.perf_counter()
        yield
        self._optics.append(time.perf_counter() - started)

    def watch_backward(self, images: Tensor) -> None:
        """Count what comes after the gradient of the images as the optics'."""
        if images.requires_grad:
            images.register_hook(self._start_backward)

    def end_backward(self) -> None:
        """Close the optics' share of the backward pass."""
        if self._backward_started is not None:
            self._optics[-1] += time.perf_counter() - self._backward_started
            self._backward_started = None

    def end(self) -> dict[str, float]:
        """End a step, and return its costs in seconds."""
        self._steps.append(time.perf_counter() - self._step_started)
        self.latest = _costs(self._steps[-1], self._optics[-1])
        return self.latest

    def numbers(self) -> dict[str, float]:
        """Return the medians of the latest steps in seconds; none before the first."""
        if not self._steps:
            return {}
        waited = {} if self.data is None else {"cost/data_s": self.data}
        return waited | _costs(statistics.median(self._steps), statistics.median(self._optics))

    def _start_backward(self, gradient: Tensor) -> None:
        self._backward_started = time.perf_counter()


def _costs(step: float, optics: float) -> dict[str, float]:
    return {"cost/step_s": step, "cost/optics_s": optics, "cost/network_s": step - optics}
