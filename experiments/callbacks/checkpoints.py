"""Callbacks write the checkpoint to resume from, and set epochs and schedules of a resumed run."""

import copy
import logging
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from dolens.errors import InputError
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


class ResumedEpochs(lightning.Callback):
    """Counts the epoch that begins where a run is resumed behind the last step of another one.

    Lightning leaves that out.  Its next checkpoint then says that no epoch is under way, and a run
    that is resumed from that one makes the steps of the epoch again.

    Attributes:
        trained: whether any step has been made.
    """

    trained = False

    def on_train_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Count the epoch, if it is not counted."""
        self.trained = True
        epochs = trainer.fit_loop.epoch_progress
        if epochs.current.ready == epochs.current.completed:
            epochs.increment_ready()
            epochs.increment_started()


class ResumedSchedules(lightning.Callback):
    """Lets the schedules of a run that is resumed be those of its own settings.

    PyTorch takes the length of a schedule for a part of its state: with the checkpoint, a run of
    more epochs would take up the shorter schedule, behind whose end learning rates rise again.
    """

    def __init__(self) -> None:
        self._begun: list[tuple[dict[str, Any], list[float]]] = []

    def on_fit_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Keep the schedules as the settings have made them, before the checkpoint's are loaded."""
        schedules = [config.scheduler for config in trainer.lr_scheduler_configs]
        self._begun = [(copy.deepcopy(s.state_dict()), _rates(s)) for s in schedules]

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Bring them to the step that the checkpoint is of."""
        if trainer.global_step == 0:
            return
        for config, (state, rates) in zip(trainer.lr_scheduler_configs, self._begun, strict=True):
            schedule = config.scheduler
            # One that waits for a metric has no length.
            if isinstance(schedule, LRScheduler) and not isinstance(schedule, ReduceLROnPlateau):
                follow_settings(schedule, state, rates)


def follow_settings(
    schedule: LRScheduler, begun: Mapping[str, Any], rates: Sequence[float]
) -> None:
    """Bring a schedule to where it stands after as many steps as the checkpoint's has made.

    The learning rates that it begins with are those of the checkpoint.  Where it is the schedule of
    the checkpoint, that one stays to the bit.

    Args:
        schedule: with the state of the checkpoint, and so its optimizer.
        begun: its state as this run's settings have made it.
        rates: of its optimizer then, one for each group.

    Raises:
        InputError: it is shorter than what has been trained.
    """
    restored = copy.deepcopy(schedule.state_dict())
    groups = schedule.optimizer.param_groups
    before = [{key: value for key, value in group.items() if key != "params"} for group in groups]
    bases = _bases(restored), _bases(begun)
    schedule.load_state_dict(_with_bases(begun, restored))
    for group, rate, then, now in zip(groups, rates, *bases, strict=True):
        group["lr"] = rate if then == now else rate * then / now
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the optimizer makes no steps between these
        try:
            for _ in range(_steps(restored)):
                schedule.step()
        except ValueError as error:
            raise InputError(f"ckpt_path: scheduler: {error}") from None
    if schedule.state_dict() == restored:
        for group, values in zip(groups, before, strict=True):
            group.update(values)


def _rates(schedule: LRScheduler) -> list[float]:
    return [group["lr"] for group in schedule.optimizer.param_groups]


def _steps(state: Mapping[str, Any]) -> int:
    """Return the steps of a schedule; one that is made of others may count by them alone."""
    return state["last_epoch"] if "last_epoch" in state else _steps(state["_schedulers"][0])


def _bases(state: Mapping[str, Any]) -> list[float]:
    return state["base_lrs"] if "base_lrs" in state else _bases(state["_schedulers"][0])


def _with_bases(begun: Mapping[str, Any], restored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a state with the learning rates that another one, of the same kind, begins with."""
    found = {**begun, **{key: restored[key] for key in ("base_lrs",) if key in begun}}
    if "_schedulers" in begun:
        pairs = zip(begun["_schedulers"], restored["_schedulers"], strict=True)
        found["_schedulers"] = [_with_bases(own, other) for own, other in pairs]
    return found
