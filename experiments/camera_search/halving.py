"""Successive halving gives most of the training to the candidates that do best on little of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dolens.errors import InputError
from dolens.experiments.checks import check_count


@dataclass(frozen=True)
class Halving:
    """Says how much each rung trains, and how many go on.

    The first rung trains all candidates for `first_epochs`, each later one `factor` times as many
    in all, and one of `factor` candidates goes on.

    Args:
        rungs: how many there are; 1 trains all to the end.
        factor: see above.
        first_epochs: of the first rung.
        least: candidates that reach the last rung, where there are as many.

    Raises:
        InputError: a number is too small.
    """

    rungs: int
    factor: int
    first_epochs: int
    least: int = 1

    def __post_init__(self) -> None:
        check_count("halving.rungs", self.rungs)
        check_count("halving.factor", self.factor, 2)
        check_count("halving.first_epochs", self.first_epochs)
        check_count("halving.least", self.least)

    @property
    def epochs(self) -> tuple[int, ...]:
        """Return the epochs that each rung ends with."""
        return tuple(self.first_epochs * self.factor**rung for rung in range(self.rungs))

    def survivors(self, scores: Mapping[str, float], always: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the candidates that go on, the best first.

        Args:
            scores: of each candidate; more is better, NaN is worst.
            always: candidates that go on whatever their scores are, besides the others.

        Raises:
            InputError: there are no candidates.
        """
        if not scores:
            raise InputError("halving: there is no candidate left")
        ranked = sorted(scores, key=lambda name: -_number(scores[name]))
        count = min(len(ranked), max(self.least, math.ceil(len(ranked) / self.factor)))
        return tuple(name for name in ranked if name in ranked[:count] or name in always)


def _number(score: float) -> float:
    return -math.inf if math.isnan(score) else score
