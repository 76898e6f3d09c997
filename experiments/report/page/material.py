"""What the page is made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dolens.experiments.report.checks import Outcome
from dolens.experiments.report.plan import Plan
from dolens.experiments.report.results import Result


@dataclass(frozen=True)
class Material:
    """The plan with all that was found.

    Attributes:
        plan: systems and items.
        results: finished runs by the names of their systems.
        comparisons: numbers of each comparison that could be made.
        outcomes: of all checks.
        failed: systems whose run ended with an error → its last words.
        made: when and by which version, one line.
        code: the fingerprint of the present code.
    """

    plan: Plan
    results: Mapping[str, Result]
    comparisons: Mapping[str, Mapping[str, float]]
    outcomes: Sequence[Outcome]
    failed: Mapping[str, str]
    made: str
    code: str

    def metrics(self, run: str) -> Mapping[str, float] | None:
        """Return the metrics of a system or comparison, or None where there are none."""
        result = self.results.get(run)
        return result.metrics if result else self.comparisons.get(run)

    def outcomes_of(self, item: str) -> list[Outcome]:
        """Return the outcomes of an item's checks."""
        return [outcome for outcome in self.outcomes if outcome.check.item == item]
