"""The checkpoint to resume from."""

from typing import Any

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint


class LastCheckpoint(ModelCheckpoint):
    """Writes the checkpoint to resume from; one of an epoch's last step when the epoch has ended.

    Before that, validation and the end of the epoch have still to come, and Lightning leaves both
    out where it resumes behind the last step: the best checkpoint might be another one then.
    """

    _waits = False

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Write it where it is due, unless the epoch ends with this step."""
        self._waits = trainer.is_last_batch
        if not self._waits:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Write it where it is due at the end of an epoch, or was at its last step."""
        super().on_train_epoch_end(trainer, pl_module)
        if self._waits:
            self._waits = False
            super().on_train_batch_end(trainer, pl_module, None, None, 0)
