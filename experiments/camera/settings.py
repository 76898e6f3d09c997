"""Settings of a camera's reconstruction and of its training."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from dolens.experiments.camera.reconstruction import Loss
from dolens.experiments.checks import check_positive
from dolens.reconstruction import RelativisticDiscriminators, Restoration


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
