"""How long the report still takes."""

from collections.abc import Iterable
from dataclasses import dataclass, field


@dataclass
class Pace:
    """The speed of this machine beside the one on which the expected times were measured.

    Attributes:
        expected: seconds of the finished runs, as systems.yaml has them.
        taken: seconds that they took.
    """

    expected: float = field(default=0.0)
    taken: float = field(default=0.0)

    def finished(self, expected: float, taken: float) -> None:
        """Count a run."""
        self.expected += expected
        self.taken += taken

    def estimate(self, seconds: float) -> float:
        """Return how long work of so many expected seconds takes here."""
        return seconds * (self.taken / self.expected if self.expected else 1.0)

    def remaining(self, current: float, elapsed: float, later: Iterable[float]) -> float:
        """Return how long the current run and all later ones still take.

        Args:
            current: expected seconds of the current run.
            elapsed: how long it has taken so far.
            later: expected seconds of the runs after it.
        """
        return max(0.0, self.estimate(current) - elapsed) + self.estimate(sum(later))
