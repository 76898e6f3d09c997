"""Run by `scripts/waiting.py` in a training of its own: between two steps it does what it is asked.

Orders come by standard input, "<work> <seconds>" with step, trace or convolution; answers go to the
file descriptor in DOLENS_ANSWERS, as JSON: seconds of each run, and what the system has counted.
"""

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import lightning
import torch
from torch import nn

from benchmarks.cases import load, make_rays


class Orders(lightning.Callback):
    """Waits for orders at the end of each step; the steps between are the training's own."""

    def __init__(self) -> None:
        self._answers = os.fdopen(int(os.environ["DOLENS_ANSWERS"]), "w")
        self._runs = {"trace": _trace(), "convolution": _convolution()}
        self._steps: list[float] = []
        self._began = self._until = 0.0
        self._usage = _usage()

    def on_train_batch_start(self, *arguments: Any) -> None:
        """Note the time."""
        self._began = time.perf_counter()

    def on_train_batch_end(self, *arguments: Any) -> None:
        """Count the step; take the next order where its time is up."""
        now = time.perf_counter()
        if self._until:
            self._steps.append(now - self._began)
            if now < self._until:
                return
            self._answer(self._steps)
        self._steps, self._until = [], 0.0
        for line in sys.stdin:
            work, seconds = line.split()
            self._usage, until = _usage(), time.perf_counter() + float(seconds)
            if work == "step":
                self._until = until
                return
            self._answer(_repeated(self._runs[work], until))
        os._exit(0)  # no more orders

    def _answer(self, seconds: list[float]) -> None:
        counted = {name: now - self._usage[name] for name, now in _usage().items()}
        print(json.dumps({"seconds": seconds, **counted}), file=self._answers, flush=True)


def _usage() -> dict[str, float]:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return {"cpu": used.ru_utime + used.ru_stime, "preempted": float(used.ru_nivcsw)}


def _repeated(run: Callable[[], Any], until: float) -> list[float]:
    seconds: list[float] = []
    while not seconds or time.perf_counter() < until:
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return seconds


def _trace() -> Callable[[], Any]:
    lens = load("cooke_triplet", torch.float32, "cpu", torch.device("cpu"))
    rays = make_rays("cooke_triplet", 100_000, torch.float32, torch.device("cpu"))
    return lambda: lens.trace(rays).position.square().sum().backward()


def _convolution() -> Callable[[], Any]:
    layer, images = nn.Conv2d(16, 16, 3, padding=1), torch.zeros(2, 16, 128, 128)
    return lambda: layer(images).square().sum().backward()
