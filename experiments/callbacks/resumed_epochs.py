"""The count of epochs of a run that was resumed between two of them."""

from typing import Any

import lightning


class ResumedEpochs(lightning.Callback):
    """Counts the epoch that begins where a run is resumed behind the last step of another one.

    Lightning leaves that out.  Its next checkpoint then says that no epoch is under way, and a run
    that is resumed from that one makes the steps of the epoch again.
    """

    def on_train_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Count the epoch, if it is not counted."""
        epochs = trainer.fit_loop.epoch_progress
        if epochs.current.ready == epochs.current.completed:
            epochs.increment_ready()
            epochs.increment_started()
