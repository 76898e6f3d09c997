"""Wall time of training steps, shared between the optics and the network."""

import statistics
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor

# Steps that medians are of, at most: a run may have any number.
_STEPS = 100_000


class StepCosts:
    """Measures the wall time of training steps.

    Waiting for data comes before a step and is no part of it.  The optics' share is the time in
    which images are made, and in the backward pass the time after the gradient has reached the
    images.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._optics: deque[float] = deque(maxlen=_STEPS)
        self.latest: dict[str, float] = {}
        self._step_started = 0.0
        self.data: float | None = None  # mean seconds of waiting for a batch, where it is measured
        self._backward_started: float | None = None

    def start(self) -> None:
        """Begin a step."""
        self._step_started = time.perf_counter()

    @contextmanager
    def making_images(self) -> Iterator[None]:
        """Count the time within as the optics'."""
        started = time.perf_counter()
        yield
        self._optics.append(time.perf_counter() - started)

    def watch_backward(self, images: Tensor) -> None:
        """Count what comes after the gradient of the images as the optics'."""
        if images.requires_grad:
            images.register_hook(self._start_backward)

    def end_backward(self) -> None:
        """Close the optics' share of the backward pass."""
        if self._backward_started is not None:
            self._optics[-1] += time.perf_counter() - self._backward_started
            self._backward_started = None

    def end(self) -> dict[str, float]:
        """End a step, and return its costs in seconds."""
        self._steps.append(time.perf_counter() - self._step_started)
        self.latest = _costs(self._steps[-1], self._optics[-1])
        return self.latest

    def numbers(self) -> dict[str, float]:
        """Return the medians of the latest steps in seconds; none before the first."""
        if not self._steps:
            return {}
        waited = {} if self.data is None else {"cost/data_s": self.data}
        return waited | _costs(statistics.median(self._steps), statistics.median(self._optics))

    def _start_backward(self, gradient: Tensor) -> None:
        self._backward_started = time.perf_counter()


def _costs(step: float, optics: float) -> dict[str, float]:
    return {"cost/step_s": step, "cost/optics_s": optics, "cost/network_s": step - optics}
