"""A run that is a trial of a search tells how it goes, and is stopped where it is hopeless."""

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import ModelCheckpoint

from dolens.errors import InputError
from dolens.experiments.search.settings import BY_MODE, SearchSettings, direction_of

logger = logging.getLogger(__name__)


class PruneTrial(lightning.Callback):
    """Tells the search of a trial how the run goes, and stops it where the pruner says so.

    The metric is the one that chooses the best checkpoint, or `hydra.sweeper.monitor`.  It is
    told before every epoch but the first, or every so many steps.

    Args:
        journal: of the search.
        number: of the trial.
        settings: of the search; they have a pruner.
    """

    def __init__(self, journal: Path, number: int, settings: SearchSettings) -> None:
        # Optuna is there only where a search is.
        from dolens.experiments.search.storage import record_of_job

        self.record, self.number = record_of_job(journal), number
        self.identity = self.record.trial(number)[0]
        self.pruner, self.settings = settings.make_pruner(), settings
        self.monitor, self.sign = "", 1.0
        self._looked = self._told = 0

    def on_fit_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Choose the metric.

        Raises:
            InputError: there is none, or nothing says whether more of it is better.
        """
        self.monitor, direction = self._monitored(trainer)
        objective = self.record.study.direction.name.lower()
        # A pruner compares as the study does.
        self.sign = 1.0 if direction == objective else -1.0

    def on_train_epoch_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Look at what the last epoch has reached.

        Raises:
            TrialPruned: the trial is hopeless.
        """
        if self.settings.every_n_steps is None and trainer.current_epoch > 0:
            self._look(trainer, trainer.current_epoch, "epoch")

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Look at what the last step has reached.

        Raises:
            TrialPruned: the trial is hopeless.
        """
        every = self.settings.every_n_steps
        step = trainer.fit_loop.total_batch_idx + 1
        if every is not None and step % every == 0:
            self._look(trainer, step, "step")

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """See that the metric was there.

        Raises:
            InputError: it was never logged.
        """
        if self._looked and not self._told:
            raise InputError(
                f"hydra.sweeper.monitor: '{self.monitor}' was never logged "
                f"({', '.join(sorted(trainer.callback_metrics))})"
            )

    def _look(self, trainer: lightning.Trainer, step: int, unit: str) -> None:
        from optuna.exceptions import UpdateFinishedTrialError

        self._looked += 1
        if self.monitor not in trainer.callback_metrics:
            return  # validation may come later
        self._told += 1
        value = float(trainer.callback_metrics[self.monitor])
        storage = self.record.storage
        try:
            storage.set_trial_intermediate_value(self.identity, step, self.sign * value)
            trial = storage.get_trial(self.identity)
            if not self.pruner.prune(self.record.study, trial):
                return
            shown = "no number" if math.isnan(value) else f"{value:.4g}"
            reason = f"{self.monitor} = {shown} after {unit} {step} is hopeless in its search"
            self.record.note(self.number, "pruned", reason)
        except UpdateFinishedTrialError:
            reason = "its search went on without it"
        raise TrialPruned(reason)

    def _monitored(self, trainer: lightning.Trainer) -> tuple[str, str]:
        checkpoints = [c for c in trainer.checkpoint_callbacks if isinstance(c, ModelCheckpoint)]
        modes = {c.monitor: BY_MODE[c.mode] for c in checkpoints if c.monitor is not None}
        wanted = self.settings.monitor or next(iter(modes), None)
        if wanted is None:
            raise InputError("hydra.sweeper.monitor: must name the metric by which to prune")
        direction = modes.get(wanted) or direction_of(wanted)
        if direction is None:
            raise InputError(
                f"hydra.sweeper.monitor: whether more of '{wanted}' is better does not follow from "
                "its name, and no checkpoint is chosen by it"
            )
        return wanted, direction


def trial_callbacks() -> list[PruneTrial]:
    """Return what a run needs as a trial of a search that prunes; nothing for any other run."""
    hydra = HydraConfig.get()
    sweeper: Mapping[str, Any] = hydra.sweeper
    if hydra.mode != RunMode.MULTIRUN or not sweeper.get("storage"):
        return []
    return [PruneTrial(Path(sweeper["storage"]), int(hydra.job.num), SearchSettings.of(sweeper))]


class TrialPruned(Exception):
    """A run is hopeless beside the others of its search; it is stopped, and has not failed.

    The message is one line that gives the number that decided.
    """
