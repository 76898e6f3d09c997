"""A callback follows the progress of a run for its display."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import lightning
from lightning.pytorch.callbacks import ProgressBar

from dolens.errors import InputError
from dolens.experiments.callbacks.progress_display import (
    Display,
    MovingAverage,
    Snapshot,
    clock_text,
    display_for,
    logger,
)
from dolens.experiments.data.photographs import shown_name
from dolens.tasks import StageEvent, listening

# Seconds between looks at the metrics: each one waits for a GPU to be done.
_LOOK_S = 0.1
# More views or photographs than these are counted and not named.
_NAMED = 3


class RunProgress(ProgressBar):
    """Shows how far a run is, what it does before its first step, and smoothed numbers.

    Displays: a bar in a terminal, a text in a notebook, lines of the log elsewhere.  Stages of the
    library (`dolens.tasks`), such as compiling kernels, are named while they last, and their time
    is not that of a step.  `trainer.enable_progress_bar=false` takes all of it away.

    Args:
        smoothing: of numbers of training and of the speed, from step to step; 0 shows the last
            ones.  See `MovingAverage`.
        every_s: seconds between lines of the log, where there is no terminal.
        display: makes the display from a function that gives the state; None: what suits the place
            where output goes.

    Raises:
        InputError: a value out of range.
    """

    def __init__(
        self,
        smoothing: float = 0.95,
        every_s: float = 30.0,
        display: Callable[[Callable[[], Snapshot]], Display] | None = None,
    ) -> None:
        super().__init__()
        if not 0.0 <= smoothing < 1.0:
            raise InputError(
                f"callbacks.progress: smoothing {smoothing}; allowed: 0 to below 1, as 0.95"
            )
        if not every_s > 0.0:
            raise InputError(f"callbacks.progress: every_s {every_s}; allowed: more than 0 (s)")
        self.smoothing, self.every_s = smoothing, every_s
        self._make = display or (lambda snapshot: display_for(snapshot, every_s))
        self._enabled = True
        self._display: Display | None = None
        self._listening = ExitStack()
        self._part, self._detail = "fit", ""
        self._done, self._total = 0, None
        self._numbers: dict[str, float] = {}
        self._averages: dict[str, MovingAverage] = {}
        self._step_s, self._pause_s = MovingAverage(smoothing), MovingAverage(0.5)
        self._stages: list[tuple[tuple[str, ...], float]] = []
        self._apart_s = 0.0  # of stages since the last step
        self._mark = self._began = self._looked = time.monotonic()
        self._names: Sequence[str] = ()
        self._seen = 0

    # ---------------------------------------------------------------- Lightning's switches

    def disable(self) -> None:
        """Show nothing, as in all processes but the first."""
        self._enabled = False

    def enable(self) -> None:
        """Show again."""
        self._enabled = True

    def setup(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str
    ) -> None:
        """Open the display before the module and the data prepare themselves."""
        super().setup(trainer, pl_module, stage)
        self._begin(stage, None)
        if self._enabled and self._display is None:
            self._display = self._make(self.snapshot)
            self._listening.enter_context(listening(self._hear))
            self._display.open()

    def teardown(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str
    ) -> None:
        """Close the display."""
        self._close()

    def on_exception(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        """Close the display, so that the message is not overwritten."""
        self._close()

    def _close(self) -> None:
        self._listening.close()
        if self._display is not None:
            self._display.close()
            self._display = None

    # ---------------------------------------------------------------- the state

    def snapshot(self) -> Snapshot:
        """Return the present state."""
        names, since = self._stages[-1] if self._stages else ((), 0.0)
        step_s = self._step_s.value
        known = step_s == step_s and step_s > 0.0 and self._part == "fit"
        return Snapshot(
            self._part,
            self._done,
            self._total,
            self._detail,
            dict(self._numbers),
            1.0 / step_s if known else None,
            self._remaining(step_s) if known else self._remaining_of_evaluation(),
            names,
            time.monotonic() - since if names else 0.0,
        )

    def _remaining(self, step_s: float) -> float | None:
        """Seconds of the steps that are left, and of what is done between epochs."""
        if self._total is None:
            return None
        left = max(self._total - self._done, 0)
        per_epoch = self.trainer.num_training_batches
        pauses = left / per_epoch * self._pause_s.value if per_epoch else 0.0
        return left * step_s + (pauses if pauses == pauses else 0.0)

    def _remaining_of_evaluation(self) -> float | None:
        if self._part == "fit" or not self._done or self._total is None:
            return None
        return (time.monotonic() - self._began) / self._done * (self._total - self._done)

    def _begin(self, part: str, total: float | None) -> None:
        self._part, self._detail, self._done = part, "", 0
        self._total = None if total is None or total == float("inf") else int(total)
        self._began = time.monotonic()

    def _hear(self, event: StageEvent) -> None:
        if event.begins:
            self._stages.append((event.names, time.monotonic()))
        elif self._stages:
            _, since = self._stages.pop()
            if not self._stages:
                self._apart_s += time.monotonic() - since
        self._update(force=True)

    def _update(self, force: bool = False) -> None:
        if self._display is not None:
            self._display.update(force)

    def _read_numbers(self, steps: int) -> None:
        """Take the metrics that are marked for a progress bar; smooth those of training."""
        for name, value in self.trainer.progress_bar_metrics.items():
            average = self._averages.setdefault(name, MovingAverage(self.smoothing**steps))
            average.smoothing = self.smoothing**steps if name.startswith("train/") else 0.0
            average.add(float(value))
            self._numbers[name] = average.value

    # ---------------------------------------------------------------- training

    def on_train_start(self, trainer: lightning.Trainer, *arguments: Any) -> None:
        """Count all steps of the training, those before a resumed one as well."""
        total = None
        if trainer.max_epochs is not None and trainer.max_epochs >= 0:
            total = trainer.max_epochs * trainer.num_training_batches
        if trainer.max_steps >= 0:
            total = trainer.max_steps if total is None else min(total, trainer.max_steps)
        self._begin("fit", total)
        self._done = trainer.fit_loop.epoch_loop.total_batch_idx + 1
        self._looked_at = self._done
        self._mark, self._apart_s = time.monotonic(), 0.0

    def on_train_epoch_start(self, trainer: lightning.Trainer, *arguments: Any) -> None:
        """Name the epoch."""
        last = trainer.max_epochs
        of = f" of {last}" if last is not None and last >= 0 else ""
        self._detail = f"epoch {trainer.current_epoch + 1}{of}"

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: Any, batch_idx: int
    ) -> None:
        """Close the pause between two epochs."""
        if batch_idx == 0:
            if trainer.current_epoch > 0 and self._done:
                self._pause_s.add(time.monotonic() - self._mark)
            self._mark, self._apart_s = time.monotonic(), 0.0

    def on_train_batch_end(self, *arguments: Any) -> None:
        """Count the step, and its time without stages."""
        now = time.monotonic()
        self._step_s.add(max(now - self._mark - self._apart_s, 1e-9))
        self._mark, self._apart_s = now, 0.0
        self._done += 1
        if now - self._looked >= _LOOK_S:
            self._looked = now
            self._read_numbers(self._done - self._looked_at)
            self._looked_at = self._done
        self._update()

    def on_train_end(self, *arguments: Any) -> None:
        """Leave one line in the log, whatever the display."""
        self._read_numbers(max(self._done - self._looked_at, 1))
        if self._enabled:
            took = clock_text(time.monotonic() - self._began)
            numbers = self.snapshot().number_text()
            logger.info("fit: %d steps, %s; %s", self._done, took, numbers or "no numbers")

    # ---------------------------------------------------------------- validation and test

    def on_validation_start(self, trainer: lightning.Trainer, module: Any) -> None:
        """Show the validation for as long as it lasts."""
        self._of_training = (self._done, self._total, self._detail, self._began)
        self._begin("validate", _batches(trainer.num_val_batches))
        self._look_up_photographs(trainer, "validation")

    def on_validation_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: Any, *arguments: Any
    ) -> None:
        """Name the photographs and views."""
        self._describe(module, batch)

    def on_validation_batch_end(self, *arguments: Any) -> None:
        """Count the batch."""
        self._done += 1
        self._update()

    def on_validation_end(self, trainer: lightning.Trainer, module: Any) -> None:
        """Go back to the training."""
        self._apart_s += time.monotonic() - self._began
        self._part = "fit" if trainer.state.fn == "fit" else self._part
        self._done, self._total, self._detail, self._began = self._of_training

    def on_test_start(self, trainer: lightning.Trainer, module: Any) -> None:
        """Show the test."""
        self._numbers = {}
        self._begin("test", _batches(trainer.num_test_batches))
        self._look_up_photographs(trainer, "test")

    def on_test_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: Any, *arguments: Any
    ) -> None:
        """Name the photographs and views."""
        self._describe(module, batch)

    def on_test_batch_end(self, *arguments: Any) -> None:
        """Count the batch."""
        self._done += 1
        self._update()

    def on_test_epoch_end(self, *arguments: Any) -> None:
        """Leave the photographs: what follows is named by stages."""
        self._detail = ""

    def _look_up_photographs(self, trainer: lightning.Trainer, split: str) -> None:
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        self._names = [] if find is None else find(split)
        self._seen = 0

    def _describe(self, module: Any, batch: Any) -> None:
        """Name what a batch of crops shows, and how it is looked at."""
        if not self._names:
            return
        names = list(
            dict.fromkeys(map(shown_name, self._names[self._seen : self._seen + len(batch)]))
        )
        self._seen += len(batch)
        labels = module.views.labels() if hasattr(module, "views") else []
        pieces = [_listed("photograph", names), _listed("view", labels)]
        self._detail = ", ".join(piece for piece in pieces if piece)
        self._update()


def _batches(counts: Any) -> float:
    return sum(counts) if isinstance(counts, list) else counts


def _listed(what: str, names: Sequence[str]) -> str:
    """Return a few names, or how many there are."""
    if not names:
        return ""
    if len(names) > _NAMED:
        return f"{len(names)} {what}s"
    return f"{what}{'s' if len(names) > 1 else ''} {', '.join(names)}"
