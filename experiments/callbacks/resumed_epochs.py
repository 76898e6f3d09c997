"""What a resumed run has of its own: its count of epochs, and its learning-rate schedules."""

import copy
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import lightning
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from dolens.errors import InputError


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
