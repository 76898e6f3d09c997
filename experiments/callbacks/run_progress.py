"""A callback follows the progress of a run for its display."""

import math
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
        self._display = Display(self.snapshot)
        self._open = ExitStack()
        self._now = _Part("fit", None)
        self._training = self._now
        self._numbers: dict[str, MovingAverage] = {}
        self._step_s = MovingAverage(smoothing)
        self._stages: list[tuple[tuple[str, ...], float]] = []
        self._apart_s = 0.0  # of stages since the last step
        self._mark = self._looked = time.monotonic()
        self._unread = 0  # steps since the metrics were looked at
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
        self._now = _Part(stage, None)
        if self._enabled and type(self._display) is Display:
            self._display = self._make(self.snapshot)
            self._open.enter_context(listening(self._hear))
            self._open.callback(self._display.close)
            self._display.open()

    def teardown(self, *arguments: Any, **options: Any) -> None:
        """Close the display; where a run fails, so that the message is not overwritten."""
        self._open.close()
        self._display = Display(self.snapshot)

    on_exception = teardown

    # ---------------------------------------------------------------- the state

    def snapshot(self) -> Snapshot:
        """Return the present state; a display's own thread may ask while a step is counted."""
        now, step_s = self._now, self._step_s.value
        names, since = [((), 0.0), *self._stages][-1]
        return Snapshot(
            now.name,
            now.done,
            now.total,
            now.detail,
            {name: average.value for name, average in dict(self._numbers).items()},
            1.0 / step_s if now.name == "fit" and step_s > 0.0 else None,
            now.remaining_s(),
            names,
            time.monotonic() - since if names else 0.0,
        )

    def _hear(self, event: StageEvent) -> None:
        if event.begins:
            self._stages.append((event.names, time.monotonic()))
        elif self._stages:
            _, since = self._stages.pop()
            if not self._stages and self._now.name == "fit":  # a validation is apart as a whole
                self._apart_s += time.monotonic() - since
        self._display.update(force=True)

    def _read_numbers(self) -> None:
        """Take the metrics that are marked for a progress bar; smooth those of training."""
        for name, value in self.trainer.progress_bar_metrics.items():
            smoothing = self.smoothing if name.startswith("train/") else 0.0
            average = self._numbers.get(name) or MovingAverage(smoothing)
            average.add(float(value), max(self._unread, 1))
            self._numbers[name] = average  # none is shown before its first number
        self._looked, self._unread = time.monotonic(), 0

    # ---------------------------------------------------------------- training

    def on_train_start(self, trainer: lightning.Trainer, *arguments: Any) -> None:
        """Count all steps of the training, those before a resumed one as well."""
        totals = [trainer.max_steps] if trainer.max_steps >= 0 else []
        if trainer.max_epochs is not None and trainer.max_epochs >= 0:
            totals.append(trainer.max_epochs * trainer.num_training_batches)
        done = trainer.fit_loop.epoch_loop.total_batch_idx + 1
        self._now = _Part("fit", min(totals, default=None), done)

    def on_train_epoch_start(self, trainer: lightning.Trainer, *arguments: Any) -> None:
        """Name the epoch."""
        last = trainer.max_epochs
        of = f" of {last}" if last is not None and last >= 0 else ""
        self._now.detail = f"epoch {trainer.current_epoch + 1}{of}"

    def on_train_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: Any, batch_idx: int
    ) -> None:
        """Leave what is done between two epochs out of the first step's time."""
        if batch_idx == 0:
            self._mark, self._apart_s = time.monotonic(), 0.0

    def on_train_batch_end(self, *arguments: Any) -> None:
        """Count the step, and its time without stages."""
        now = time.monotonic()
        self._step_s.add(max(now - self._mark - self._apart_s, 1e-9))
        self._mark, self._apart_s = now, 0.0
        self._unread += 1
        self._now.count()
        if now - self._looked >= _LOOK_S:
            self._read_numbers()
        self._display.update()

    def on_train_end(self, *arguments: Any) -> None:
        """Leave one line in the log, whatever the display."""
        self._read_numbers()
        if self._enabled:
            took = clock_text(time.monotonic() - self._now.began)
            numbers = self.snapshot().number_text()
            logger.info("fit: %d steps, %s; %s", self._now.done, took, numbers or "no numbers")

    # ---------------------------------------------------------------- validation and test

    def on_validation_start(self, trainer: lightning.Trainer, module: Any) -> None:
        """Show the validation for as long as it lasts."""
        self._training = self._now
        self._evaluate(trainer, "validate", "validation", trainer.num_val_batches)

    def on_test_start(self, trainer: lightning.Trainer, module: Any) -> None:
        """Show the test."""
        self._numbers = {}
        self._evaluate(trainer, "test", "test", trainer.num_test_batches)

    def _evaluate(self, trainer: lightning.Trainer, part: str, split: str, batches: Any) -> None:
        total = sum(batches) if isinstance(batches, list) else batches
        self._now = _Part(part, total)
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        self._names, self._seen = [] if find is None else find(split), 0

    def on_validation_batch_start(
        self, trainer: lightning.Trainer, module: Any, batch: Any, *arguments: Any
    ) -> None:
        """Name what a batch of crops shows, and how it is looked at."""
        if not self._names:
            return
        shown = self._names[self._seen : self._seen + len(batch)]
        self._seen += len(batch)
        labels = module.views.labels() if hasattr(module, "views") else []
        pieces = [_listed("photograph", [*map(shown_name, shown)]), _listed("view", labels)]
        self._now.detail = ", ".join(piece for piece in pieces if piece)
        self._display.update()

    def on_validation_batch_end(self, *arguments: Any) -> None:
        """Count the batch."""
        self._now.count()
        self._display.update()

    on_test_batch_start, on_test_batch_end = on_validation_batch_start, on_validation_batch_end

    def on_validation_end(self, trainer: lightning.Trainer, module: Any) -> None:
        """Go back to the training."""
        if trainer.state.fn == "fit":
            self._apart_s += time.monotonic() - self._now.began
            self._now = self._training

    def on_test_epoch_end(self, *arguments: Any) -> None:
        """Leave the photographs: what follows is named by stages."""
        self._now.detail = ""


class _Part:
    """A part of a run: how many of its steps are done, and where it is.

    Args:
        name: `fit`, `validate` or `test`.
        total: steps in all; None or infinite, as of data without a length: nobody knows.
        done: before it began here, as of a run that is resumed.
    """

    def __init__(self, name: str, total: float | None, done: int = 0) -> None:
        self.name, self.done, self.detail = name, done, ""
        self.total = int(total) if total is not None and math.isfinite(total) else None
        self.began = time.monotonic()
        self._from: tuple[int, float] | None = None if name == "fit" else (done, self.began)

    def count(self) -> None:
        """Count a step."""
        self.done += 1
        if self._from is None:  # a first step may compile: time is counted from its end
            self._from = (self.done, time.monotonic())

    def remaining_s(self) -> float | None:
        """Return the seconds that are left if they go on as so far, pauses included."""
        done, since = self._from or (self.done, 0.0)
        if self.total is None or self.done <= done:
            return None
        per_step = (time.monotonic() - since) / (self.done - done)
        return per_step * max(self.total - self.done, 0)


def _listed(what: str, names: Sequence[str]) -> str:
    """Return a few names, or how many there are."""
    names = list(dict.fromkeys(names))
    if not names:
        return ""
    if len(names) > _NAMED:
        return f"{len(names)} {what}s"
    return f"{what}{'s' if len(names) > 1 else ''} {', '.join(names)}"
