"""A search's budget is seconds of one core; what it had found when is kept here."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lens_search.plain_trace import Array
from lens_search.quartet import UNITS, Measured


class OutOfTime(Exception):
    """The seconds are used up."""


@dataclass
class Progress:
    """What a search finds as its processor time goes on.

    Attributes:
        seconds: of processor time that the search has.
        air_stop: whether the stop must lie in air.
        evaluations: lenses traced so far, those for derivatives too.
        history: (processor seconds, evaluations, merit, candidate) of every new best design that
            keeps all limits.
        designs: (processor seconds, merit, candidate) of each local optimum of a multi-start.
        merit: of the best design that keeps all limits.
        nearest: (sum of broken limits in `UNITS`, candidate) of the best that breaks some.
    """

    seconds: float
    air_stop: bool = False
    evaluations: int = 0
    history: list[tuple[float, int, float, Array]] = field(default_factory=list)
    designs: list[tuple[float, float, Array]] = field(default_factory=list)
    merit: float = np.inf
    nearest: tuple[float, Array | None] = (np.inf, None)
    begun: float = field(default_factory=time.process_time)

    @property
    def spent(self) -> float:
        """Processor seconds since the search began."""
        return time.process_time() - self.begun

    def check(self, part: float = 1.0) -> None:
        """Raise `OutOfTime` when a part of the seconds is used up."""
        if self.spent > part * self.seconds:
            raise OutOfTime

    def see(self, candidates: Array, measured: Measured) -> None:
        """Count candidates that were measured, and keep the best."""
        self.evaluations += len(candidates)
        kept = np.where(measured.feasible, measured.mean, np.inf)
        place = int(kept.argmin())
        if kept[place] < self.merit:
            self.merit = float(kept[place])
            self.history.append(
                (self.spent, self.evaluations, self.merit, candidates[place].copy())
            )
        if not self.history:
            broken = (measured.excess / UNITS).sum(axis=1) + 1e-3 * measured.mean
            place = int(broken.argmin())
            if broken[place] < self.nearest[0]:
                self.nearest = (float(broken[place]), candidates[place].copy())

    def at(self, marks: Sequence[float]) -> list[float]:
        """Return the best merit at times, in processor seconds, µm; infinity before the first."""
        return [
            min((merit for spent, _, merit, _ in self.history if spent <= mark), default=np.inf)
            for mark in marks
        ]

    def as_data(self) -> dict[str, Any]:
        """Return what was found as plain data, for a file."""
        near, row = self.nearest
        return {
            "seconds": self.seconds,
            "air_stop": self.air_stop,
            "spent": self.spent,
            "evaluations": self.evaluations,
            "history": [(s, n, m, list(map(float, x))) for s, n, m, x in self.history],
            "designs": [(s, m, list(map(float, x))) for s, m, x in self.designs if m < math.inf],
            "started": len(self.designs),
            "nearest": None if row is None else [near, list(map(float, row))],
        }

    @property
    def best(self) -> Array | None:
        """The best candidate; one that breaks limits where none keeps them."""
        return self.history[-1][3] if self.history else self.nearest[1]
