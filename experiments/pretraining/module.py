"""Training of a restorer of any lens."""

from typing import Any

import lightning
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.experiment import EXACT, MIXED, Experiment
from dolens.experiments.pretraining.examples import Example
from dolens.reconstruction.general import GeneralRestoration, Prepared

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
