"""A warning where other work takes the processors from a run, and what the run used of them."""

import logging
import os
import time
from typing import Any

import lightning
import torch

from dolens.threads import ThreadClock, ThreadTimes, allowed_processors

logger = logging.getLogger(__name__)

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
