"""A training that is a rung of several ends where its rung does, and leaves its scores there."""

from pathlib import Path

import lightning

from dolens.experiments.camera.photograph_scores import table_name
from dolens.experiments.tables import write_table


def stage_of(epochs: int) -> str:
    """Return the stage whose table has the validation after so many epochs."""
    return f"val_{epochs}_epochs"


class EndOfRung(lightning.Callback):
    """Ends the training after some of its epochs; learning rates are those of the whole.

    The scores of the last validation are written by photograph, as those of a test are.

    Args:
        epochs: in all, counted from the training's own start.
        folder: the run folder.
    """

    def __init__(self, epochs: int, folder: str) -> None:
        self.epochs, self.folder = epochs, Path(folder)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Stop behind the last epoch of the rung."""
        if trainer.current_epoch + 1 >= self.epochs:
            trainer.should_stop = True

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the scores."""
        scores = getattr(pl_module, "validation_scores", None)
        if scores is not None:
            write_table(self.folder / table_name(stage_of(self.epochs)), scores.rows())
