"""Callbacks end a run that has no finite numbers or no objective, tell how a run goes on, and warn
where other work takes its processors.
"""

import logging
import os
import shlex
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.running.command_line import override_text
from dolens.experiments.running.run_settings import no_metric
from dolens.experiments.search.pruning import TrialPruned
from dolens.threads import ThreadClock, ThreadTimes, allowed_processors

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


# So many names are in a message.
_NAMED = 4


class FiniteTraining(lightning.Callback):
    """Ends a training whose loss, gradient or state is not finite.

    The loss and its gradient are looked at before the optimizer moves anything by them, and the
    state before a checkpoint is written: the checkpoints of a run are finite.  Where a search makes
    its own steps, as of least squares, it takes back by itself what is not finite, and its state
    alone is looked at.

    Args:
        skipped_steps: how many steps in a row may be left out, with a warning, where loss or
            gradient is not finite.  One more ends the run.

    Raises:
        InputError: a number below 0.
    """

    def __init__(self, skipped_steps: int = 0) -> None:
        if skipped_steps < 0:
            raise InputError(f"callbacks.finite: skipped_steps {skipped_steps}; allowed: 0 or more")
        self.skipped_steps = skipped_steps
        self._in_a_row = 0
        self._fault = ""
        self._unset: set[str] = set()

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Note what is not finite as training begins, as a best merit that nothing reached yet."""
        self._unset = set(_not_finite(pl_module.state_dict().items()))

    def on_before_backward(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, loss: Tensor
    ) -> None:
        """Look at the loss.

        Raises:
            InputError: it is not finite, and no further step may be left out.
        """
        if not pl_module.automatic_optimization or bool(torch.isfinite(loss.detach()).all()):
            return
        logged = trainer.callback_metrics
        terms = [f"{n} {float(logged[n])}" for n in _not_finite(logged.items()) if "train/" in n]
        self._fault = f"the loss is not finite ({', '.join(terms) or float(loss.detach())})"
        self._refuse_if_too_many(trainer)

    def on_before_optimizer_step(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        optimizer: torch.optim.Optimizer,
    ) -> None:
        """Look at the gradient, and drop it where the step is left out.

        Raises:
            InputError: it is not finite, and no further step may be left out.
        """
        # Where losses are scaled up for half precision, the scaler leaves out what overflows.
        scaled = getattr(trainer.precision_plugin, "scaler", None) is not None
        if not pl_module.automatic_optimization or scaled:
            return
        if not self._fault:
            gradients = ((n, p.grad) for n, p in pl_module.named_parameters() if p.grad is not None)
            names = _not_finite(gradients)
            if not names:
                self._in_a_row = 0
                return
            self._fault = f"the gradient is not finite (of {_listed(names)})"
            self._refuse_if_too_many(trainer)
        logger.warning("Step %d is left out: %s", trainer.global_step + 1, self._fault)
        # What has no gradient stays as it is, whatever momentum it has.
        optimizer.zero_grad(set_to_none=True)
        self._in_a_row, self._fault = self._in_a_row + 1, ""

    def _refuse_if_too_many(self, trainer: lightning.Trainer) -> None:
        if self._in_a_row < self.skipped_steps:
            return
        find = getattr(trainer.datamodule, "training_photographs", None)
        names = [] if find is None else list(dict.fromkeys(find()))
        of = f", photographs {_listed(names)}" if names else ""
        after = f" for {self._in_a_row + 1} steps in a row" if self._in_a_row else ""
        raise InputError(
            f"step {trainer.global_step + 1}{of}: {self._fault}{after}; nothing moved by it, and "
            "the checkpoints are those before it (lower learning_rates, or allow "
            "callbacks.finite.skipped_steps)"
        )

    def on_save_checkpoint(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        checkpoint: dict[str, Any],
    ) -> None:
        """Look at the state.

        Raises:
            InputError: a part of it that was finite is not any more.
        """
        names = [n for n in _not_finite(checkpoint["state_dict"].items()) if n not in self._unset]
        if names and trainer.training:
            raise InputError(
                f"step {trainer.global_step}: {_listed(names)} is not finite any more; no "
                "checkpoint is written of it, and those before it stay"
            )


def _not_finite(tensors: Iterable[tuple[str, Tensor]]) -> list[str]:
    """Return the names of the tensors that have a number that is not finite."""
    return [name for name, value in tensors if not bool(torch.isfinite(value).all())]


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"


class LoggedObjectives(lightning.Callback):
    """Looks for a run's objectives among the metrics of the first validation.

    Args:
        objectives: names of metrics; those that do not begin with `val/` come from elsewhere.
    """

    def __init__(self, objectives: Sequence[str]) -> None:
        self._wanted = [name for name in objectives if name.startswith("val/")]

    def on_validation_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Look, once.

        Raises:
            InputError: the validation has logged no such metric.
        """
        if trainer.sanity_checking:
            return
        there = sorted(name for name in trainer.callback_metrics if name.startswith("val/"))
        for name in self._wanted:
            if name not in there:
                raise no_metric(name, there)
        self._wanted = []


# A run beside one other program on two processors waits for a third of its time; alone on them,
# for one or two percent.  One that sleeps for most of the time does not lose much by waiting.
_SHARE, _WINDOW_S, _OF_WINDOW = 0.2, 20.0, 0.1


class StarvationWarning(lightning.Callback):
    """Warns once where the run's threads wait for processors that other work has.

    It goes by the system's count of the time in which threads were ready to run and did not (Linux;
    elsewhere nothing is counted).  Threads that wait for data, a disk or each other asleep are not
    ready, and count for nothing.

    Args:
        window_s: seconds that are looked at together, at least.
        share: of the time in which threads could run, from which on waiting is worth a warning.
    """

    def __init__(self, window_s: float = _WINDOW_S, share: float = _SHARE) -> None:
        self.window_s, self.share = window_s, share
        self._clock, self._since = ThreadClock(), time.monotonic()
        self._used_before = time.process_time()
        self._waited, self._counted, self._said = 0.0, False, False

    def look(self) -> None:
        """Warn if the last window is at its end and was a bad one."""
        window = time.monotonic() - self._since
        if window < self.window_s:
            return
        times = self._lap()
        if times is None or self._said or times.share_waited < self.share:
            return
        if times.waited < _OF_WINDOW * window:
            return
        self._said = True
        logger.warning(
            "This run is starved: in %.0f s its threads (%d) had a processor for %.0f s and waited "
            "for one for %.0f s (%.0f %%; load %.1f, %d processors). Other work takes the rest, "
            "data.num_workers too: run fewer jobs at once, give each threads=1, or set "
            "OMP_WAIT_POLICY=passive",
            window,
            torch.get_num_threads(),
            times.ran,
            times.waited,
            100.0 * times.share_waited,
            os.getloadavg()[0],
            allowed_processors(),
        )

    def numbers(self) -> dict[str, float]:
        """Return `cost/cpu_s` and, where the system counts it, `cost/cpu_wait_s`, so far."""
        self._lap()
        found = {"cost/cpu_s": time.process_time() - self._used_before}
        return found | ({"cost/cpu_wait_s": self._waited} if self._counted else {})

    def _lap(self) -> ThreadTimes | None:
        times, self._since = self._clock.lap(), time.monotonic()
        if times is not None:
            self._waited, self._counted = self._waited + times.waited, True
        return times

    def on_train_batch_end(self, *arguments: Any) -> None:
        """Look after each step, and so on after each batch and at each end."""
        self.look()

    on_validation_batch_end = on_test_batch_end = on_train_end = on_test_end = on_train_batch_end
