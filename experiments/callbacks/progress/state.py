"""The state of a run for its display: how far it is, what it does, and its smoothed numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


class MovingAverage:
    """An exponential moving average, free of the bias of its start.

    After n numbers x_k it is Σ s^(n-k) x_k / Σ s^(n-k) with the smoothing s (Kingma and Ba, 2015,
    section 3).  After a number that is not finite it is that number, so that nothing hides it.

    Args:
        smoothing: s, from 0 (the last number alone) to below 1.
    """

    def __init__(self, smoothing: float) -> None:
        self.smoothing = smoothing
        self._sum = self._weight = 0.0
        self._last = math.nan

    def add(self, number: float) -> None:
        """Take a further number into account."""
        self._last = number
        if math.isfinite(number):
            self._sum = self.smoothing * self._sum + number
            self._weight = self.smoothing * self._weight + 1.0

    @property
    def value(self) -> float:
        """The average; NaN before the first number."""
        if not math.isfinite(self._last):
            return self._last
        return self._sum / self._weight


@dataclass(frozen=True)
class Snapshot:
    """A run as it is displayed.

    Attributes:
        part: `fit`, `validate` or `test`.
        done: steps of the part that are done.
        total: all its steps, or None where nobody knows.
        detail: where in the part the run is, such as the epoch or the photographs.
        numbers: name → number.
        steps_per_second: or None before it is known.
        remaining_s: seconds to the part's end, or None before they are known.
        stages: names of what is being done, the last a part of those before; empty between them.
        stage_s: seconds since the last of them began.
    """

    part: str
    done: int = 0
    total: int | None = None
    detail: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    steps_per_second: float | None = None
    remaining_s: float | None = None
    stages: Sequence[str] = ()
    stage_s: float = 0.0

    def headline(self) -> str:
        """Return steps, speed, remaining time and place."""
        what = "step" if self.part == "fit" else "batch"
        steps = f"{self.done}" if self.total is None else f"{self.done} of {self.total}"
        pieces = [f"{what} {steps}"]
        if self.steps_per_second is not None:
            pieces.append(speed_text(self.steps_per_second))
        if self.remaining_s is not None and self.done != self.total:
            pieces.append(f"{clock_text(self.remaining_s)} left")
        return ", ".join(piece for piece in (*pieces, self.detail) if piece)

    def number_text(self) -> str:
        """Return the numbers; those of training without their `train/`."""
        return ", ".join(
            f"{name.removeprefix('train/')} {value:.4g}" for name, value in self.numbers.items()
        )

    def stage_text(self) -> str:
        """Return what is being done, the whole before its parts."""
        return " › ".join(self.stages)


def clock_text(seconds: float) -> str:
    """Return a duration as h:mm:ss, or m:ss below an hour."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def speed_text(per_second: float) -> str:
    """Return a speed, per minute where a step takes longer than two seconds."""
    if per_second < 0.5:
        return f"{60.0 * per_second:.2g} steps/min"
    return f"{per_second:.3g} steps/s"
