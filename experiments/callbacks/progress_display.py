"""The progress of a run is displayed in a terminal, in a notebook, or as lines of the log."""

import io
import logging
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text


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

    def add(self, number: float, steps: int = 1) -> None:
        """Take a further number into account, so many steps after the one before."""
        if math.isfinite(number):
            share = self.smoothing**steps
            self._sum = share * self._sum + number
            self._weight = share * self._weight + 1.0
        self._last = number  # at the end: another thread may ask for the value meanwhile

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


logger = logging.getLogger("dolens.experiments.progress")

_REFRESHES_PER_SECOND = 4
_BAR_WIDTH = 30


class Display:
    """Shows the progress of a run; this one shows nothing.

    Args:
        snapshot: gives the present state.
    """

    def __init__(self, snapshot: Callable[[], Snapshot]) -> None:
        self.snapshot = snapshot
        self._last = -math.inf

    def open(self) -> None:
        """Begin."""

    def update(self, force: bool = False) -> None:
        """Show the present state, if it is time; at once where something else has begun."""

    def close(self) -> None:
        """End."""

    def _is_time(self, seconds: float) -> bool:
        """Return whether so many seconds have passed since this was true."""
        now = time.monotonic()
        if now - self._last < seconds:
            return False
        self._last = now
        return True


def display_for(snapshot: Callable[[], Snapshot], every_s: float) -> Display:
    """Return the display that suits where the run's output goes.

    That is a bar in a terminal, a text that changes in a notebook, and else lines of the log.  A
    process that another one has started, as for a parallel sweep, shares its terminal with others,
    and so writes lines of the log too.

    Args:
        snapshot: gives the present state.
        every_s: seconds between lines of the log.
    """
    console = Console(stderr=True)
    alone = multiprocessing.current_process().name == "MainProcess"
    if alone and console.is_jupyter:
        return NotebookDisplay(snapshot)
    if alone and console.is_terminal and not console.is_dumb_terminal:
        return TerminalDisplay(snapshot, console)
    return LogDisplay(snapshot, every_s)


class LogDisplay(Display):
    """Writes a line of the log every so many seconds, and one when a stage is entered first."""

    def __init__(self, snapshot: Callable[[], Snapshot], every_s: float) -> None:
        super().__init__(snapshot)
        self.every_s = every_s
        self._said: set[str] = set()

    def update(self, force: bool = False) -> None:
        """Write a line if it is time, or if a stage is new."""
        now = self.snapshot()
        if now.stages:
            line = f"{now.part}: {now.stage_text().partition(':')[0]}"
            if line not in self._said:
                self._said.add(line)
                logger.info("%s", line)
        elif not force and now.done and self._is_time(self.every_s):
            numbers = now.number_text()
            logger.info("%s: %s%s", now.part, now.headline(), f"; {numbers}" if numbers else "")


class NotebookDisplay(Display):
    """Shows a text in the output of a notebook's cell, which changes a few times a second."""

    _handle: Any = None

    def open(self) -> None:
        """Make the place of the text."""
        from IPython.display import display

        self._handle = display({"text/plain": "…"}, raw=True, display_id=True)

    def update(self, force: bool = False) -> None:
        """Change the text."""
        if self._handle is not None and (self._is_time(1.0 / _REFRESHES_PER_SECOND) or force):
            self._handle.update({"text/plain": plain_text(self.snapshot())}, raw=True)

    def close(self) -> None:
        """Leave the last state as it is."""
        self.update(force=True)
        self._handle = None


class TerminalDisplay(Display):
    """Shows a bar in the last lines of a terminal; lines of the log go above it.

    A thread draws it a few times a second.
    """

    def __init__(self, snapshot: Callable[[], Snapshot], console: Console) -> None:
        super().__init__(snapshot)
        self.console = console
        self._spinner = Spinner("dots")
        self._open = ExitStack()

    def open(self) -> None:
        """Draw the bar."""
        live = Live(
            console=self.console,
            get_renderable=self.renderable,
            refresh_per_second=_REFRESHES_PER_SECOND,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
            redirect_stderr=True,
        )
        self._open.enter_context(logging_above(self.console))
        self._open.enter_context(live)

    def close(self) -> None:
        """Take the bar away."""
        self._open.close()

    def renderable(self) -> RenderableType:
        """Return the lines: bar and place, numbers, and what is being done."""
        now = self.snapshot()
        unknown = now.total is None or now.done == 0  # a bar that stands at 0 says nothing
        bar = ProgressBar(
            total=None if unknown else float(max(now.total, 1)),
            completed=float(now.done),
            width=_BAR_WIDTH,
            pulse=unknown,
        )
        first = Table.grid(padding=(0, 1))
        first.add_row(Text(now.part, style="bold"), bar, _line(now.headline()))
        lines: list[RenderableType] = [first]
        if now.numbers:
            lines.append(_line(" " * (len(now.part) + 1) + now.number_text()))
        if now.stages:
            self._spinner.text = _line(f"{now.stage_text()}, {clock_text(now.stage_s)}")
            lines.append(self._spinner)
        return Group(*lines)


def plain_text(now: Snapshot) -> str:
    """Return a state as lines of text with a bar of characters."""
    share = 0.0 if not now.total else min(now.done / now.total, 1.0)
    full = round(share * _BAR_WIDTH)
    bar = "" if now.total is None else "█" * full + "░" * (_BAR_WIDTH - full) + " "
    lines = [f"{now.part} {bar}{now.headline()}"]
    if now.numbers:
        lines.append(now.number_text())
    if now.stages:
        lines.append(f"{now.stage_text()} …")
    return "\n".join(lines)


def _line(text: str) -> Text:
    return Text(text, no_wrap=True, overflow="ellipsis")


@contextmanager
def logging_above(console: Console) -> Iterator[None]:
    """Have handlers of the log that write to a terminal write above a live display."""
    loggers = [logging.getLogger(), *map(logging.getLogger, list(logging.root.manager.loggerDict))]
    handlers = [
        handler
        for handler in dict.fromkeys(h for each in loggers for h in each.handlers)
        if isinstance(handler, logging.StreamHandler) and _is_terminal(handler.stream)
    ]
    streams = [handler.setStream(_Above(console, handler.stream)) for handler in handlers]
    try:
        yield
    finally:
        for handler, stream in zip(handlers, streams, strict=True):
            handler.setStream(stream)


def _is_terminal(stream: Any) -> bool:
    """Return whether a stream, which a handler may lack or have closed, is a terminal."""
    return not getattr(stream, "closed", True) and stream.isatty()


class _Above(io.TextIOBase):
    """A stream into a console; in a forked process, which has no console of its own, the old one.

    Args:
        console: with the live display.
        stream: the old one.
    """

    def __init__(self, console: Console, stream: TextIO) -> None:
        self._console, self._stream, self._home = console, stream, os.getpid()

    def write(self, text: str) -> int:
        """Write text as it is."""
        if os.getpid() != self._home:
            return self._stream.write(text)
        self._console.print(
            text, end="", markup=False, highlight=False, emoji=False, soft_wrap=True
        )
        return len(text)

    def flush(self) -> None:
        """Flush the old stream."""
        self._stream.flush()

    def isatty(self) -> bool:
        """Return True, as the old stream does."""
        return True
