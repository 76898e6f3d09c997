"""The checkpoint to resume from."""

import logging
import shutil
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint

from dolens.files import written_whole

logger = logging.getLogger(__name__)


class LastCheckpoint(ModelCheckpoint):
    """Writes the checkpoint to resume from; one of an epoch's last step when the epoch has ended.

    Before that, validation and the end of the epoch have still to come, and Lightning leaves both
    out where it resumes behind the last step: the best checkpoint might be another one then.
    """

    _waits = False
    _trains = False

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Keep the checkpoint that the run took up, where that left nothing to train."""
        if self._trains or trainer.ckpt_path is None:
            return
        logger.warning(
            "ckpt_path: %s has been trained to the end (trainer.max_epochs=%s): nothing is left to "
            "train, and it is the last checkpoint of this run too",
            trainer.ckpt_path,
            trainer.max_epochs,
        )
        file = Path(str(self.dirpath), f"{self.filename}.ckpt")
        if trainer.is_global_zero and not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(file) as aside:
                shutil.copyfile(str(trainer.ckpt_path), aside)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Write it where it is due, unless the epoch ends with this step."""
        self._trains, self._waits = True, trainer.is_last_batch
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
