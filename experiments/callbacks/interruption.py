"""A notice to the user when a run stops early."""

import logging
import shlex
from pathlib import Path

import lightning

from dolens.experiments.running.override_text import override_text
from dolens.experiments.search.pruned import TrialPruned

logger = logging.getLogger(__name__)


class InterruptionNotice(lightning.Callback):
    """Logs how to resume a run that was interrupted or has failed.

    It names the last checkpoint, or the best if there is no last one.

    Args:
        folder: the folder of the checkpoints.
        command: the command that starts the same run again.
    """

    def __init__(self, folder: str | Path, command: str) -> None:
        self.folder = Path(folder)
        self.command = command

    def on_exception(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        """Log one line; none where a search has given the run up."""
        if isinstance(exception, TrialPruned):
            return
        written = [self.folder / f"{name}.ckpt" for name in ("last", "best")]
        newest = next((path for path in written if path.exists()), None)
        if newest is not None:
            logger.warning(
                "Stopped at step %d (%s). Resume with: %s %s",
                trainer.global_step,
                type(exception).__name__,
                self.command,
                shlex.quote(f"ckpt_path={override_text(str(newest))}"),
            )
        else:
            logger.warning(
                "Stopped at step %d (%s), before the first checkpoint.",
                trainer.global_step,
                type(exception).__name__,
            )
