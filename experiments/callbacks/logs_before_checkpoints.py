"""What was logged is on the disk before a checkpoint that comes after it."""

from typing import Any

import lightning


class LogsBeforeCheckpoints(lightning.Callback):
    """Lets loggers write what waits in memory, whenever a checkpoint is written.

    A run that is killed and goes on from the checkpoint does not make those steps again.
    """

    def on_save_checkpoint(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        checkpoint: dict[str, Any],
    ) -> None:
        """Write."""
        for entry in trainer.loggers:
            entry.save()
