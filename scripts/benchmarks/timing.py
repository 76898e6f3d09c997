"""Timing by turns: A B A B ..., so that a busy machine slows all of them alike."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

# Shorter runs are preceded by an untimed one of their own kind: the caches are then theirs.
SETTLE, SLOW = 0.05, 0.5


@dataclass(frozen=True)
class Contender:
    """Something to time.

    Attributes:
        name: as the table says it.
        run: does it once; what it returns is freed before the next run, outside the timed part.
        amount: rays (or images, or iterations) of one run; times are given for one of them.
    """

    name: str
    run: Callable[[], Any]
    amount: float = 1.0


@dataclass(frozen=True)
class Timing:
    """Seconds per unit of amount, or why there are none.

    Attributes:
        seconds: of every round, (rounds,).
        failure: what a failed contender said, else empty.
    """

    seconds: np.ndarray
    failure: str = ""

    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile, seconds."""
        return quartiles(self.seconds)

    def columns(self, scale: float, unit: str) -> dict[str, Any]:
        """Return a row's columns of time in a unit, of which a second has so many."""
        low, middle, high = (scale * value for value in self.quartiles())
        return {
            "value": middle,
            "low": low,
            "high": high,
            "unit": unit,
            "runs": len(self.seconds),
            "note": f"failed: {self.failure}" if self.failure else "",
            "failed": bool(self.failure),
        }

    def ratio(self, other: "Timing") -> tuple[float, float, float]:
        """Quartiles of how many times longer the other takes, round by round."""
        return quartiles(other.seconds / self.seconds)


def quartiles(values: np.ndarray) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile; NaN where there are no values."""
    if len(values) == 0:
        return (float("nan"),) * 3
    low, middle, high = np.percentile(values, (25, 50, 75))
    return float(low), float(middle), float(high)


def timed(
    run: Callable[[], Any], device: torch.device, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Seconds of one run by a clock, until the device has finished."""
    _finish(device)
    start = clock()
    result = run()
    _finish(device)
    seconds = clock() - start
    del result
    return seconds


def by_turns(
    contenders: Sequence[Contender],
    budget: float,
    device: torch.device,
    least: int = 3,
    most: int = 51,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timing]:
    """Time contenders one after the other, again and again.

    Args:
        contenders: the first run of each is not counted.
        budget: seconds after which no new round begins, once there are `least`.
        device: where they run.
        least: rounds in any case.
        most: rounds at most.
        clock: of a run's seconds; `time.process_time` does not count the time of other programs,
            and adds up that of all threads.

    Returns:
        By name.  A contender that raises is out, and its message kept.
    """
    seconds: dict[str, list[float]] = {c.name: [] for c in contenders}
    failures: dict[str, str] = {}
    settle: dict[str, bool] = {}
    for contender in contenders:
        try:
            # The first may compile; a run that is slow even so needs no second.
            first = timed(contender.run, device, clock)
            again = timed(contender.run, device, clock) if first < SLOW else first
            settle[contender.name] = again < SETTLE
        except Exception as error:  # of any program: the table says what happened
            failures[contender.name] = f"{type(error).__name__}: {error}".splitlines()[0]
    left = [c for c in contenders if c.name not in failures]
    end = time.perf_counter() + budget
    for round_number in range(most if left else 0):
        if round_number >= least and time.perf_counter() > end:
            break
        for contender in left:
            if settle[contender.name]:
                timed(contender.run, device)
            seconds[contender.name].append(timed(contender.run, device, clock) / contender.amount)
    return {
        name: Timing(np.asarray(values), failures.get(name, "")) for name, values in seconds.items()
    }


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
