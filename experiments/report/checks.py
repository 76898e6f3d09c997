"""Runs are checked against a file of expected values."""

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dolens.errors import InputError, check_choice
from dolens.experiments.report.plan import FOLDER, Plan, read_yaml
from dolens.experiments.report.runs import Result
from dolens.typed_values import call_with_settings

# kind of an expected value → what it rests on
SOURCES = {
    "printed": "printed in the supplement",
    "exact": "arithmetic of 28 or 80 digits by other programs",
    "measured": "earlier runs of ours",
    "statement": "a claim of this project, with what it rests on",
}


@dataclass(frozen=True)
class Check:
    """A metric and what it should be.

    Give `expected` with `tolerance`, or one or both of `low` and `high`.

    Attributes:
        item: the item of the supplement that it belongs to.
        run: the system or comparison.
        metric: its name in metrics.json.
        what: the statement that is checked.
        kind: of SOURCES.
        source: where the expected value comes from.
        expected: the value, or None.
        tolerance: the largest deviation from it that passes.
        low: the least value that passes, or None.
        high: the largest value that passes, or None.
        unit: of all these numbers; empty where they have none.
    """

    item: str
    run: str
    metric: str
    what: str
    kind: str
    source: str
    expected: float | None = None
    tolerance: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        where = f"expected.yaml: {self.run}: {self.metric}"
        check_choice(self.kind, SOURCES, f"{where}: kind")
        if (self.expected is None) != (self.tolerance is None):
            raise InputError(f"{where}: expected and tolerance go together")
        limits = self.low is not None or self.high is not None
        if limits == (self.expected is not None):
            raise InputError(f"{where}: give either expected and tolerance, or low or high")

    def holds_for(self, value: float) -> bool:
        """Return whether a value passes; one that is no number never does."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        if self.expected is not None and self.tolerance is not None:
            low, high = self.expected - self.tolerance, self.expected + self.tolerance
        return low <= value <= high


class State(enum.StrEnum):
    """What came of a check."""

    HOLDS = "holds"
    FAILS = "does not hold"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class Outcome:
    """A check with the value that was found.

    Attributes:
        check: the check.
        state: what came of it.
        value: the metric's value; None where the run was not made or lacks the metric.
        note: what is missing, or empty.
    """

    check: Check
    state: State
    value: float | None
    note: str = ""


def load_checks(plan: Plan) -> tuple[Check, ...]:
    """Read expected.yaml.

    Raises:
        InputError: an unknown or missing key, or a system or item that the plan lacks.
    """
    entries = read_yaml(FOLDER / "expected.yaml")["checks"]
    checks = tuple(call_with_settings(Check, entry, "expected.yaml: checks") for entry in entries)
    runs = [*(s.name for s in plan.systems), *(c.name for c in plan.comparisons)]
    items = [item.item for item in plan.items()]
    for check in checks:
        check_choice(check.run, runs, f"expected.yaml: {check.metric}: run")
        check_choice(check.item, items, f"expected.yaml: {check.metric}: item")
    return checks


def outcomes(
    checks: Sequence[Check], metrics: Mapping[str, Mapping[str, float]]
) -> tuple[Outcome, ...]:
    """Return what comes of each check.

    A finished run that lacks the metric fails the check: it would otherwise pass for ever after
    the metric is renamed.

    Args:
        checks: all checks.
        metrics: name of a finished run or comparison → its metrics.
    """
    return tuple(_outcome(check, metrics.get(check.run)) for check in checks)


def _outcome(check: Check, metrics: Mapping[str, float] | None) -> Outcome:
    if metrics is None:
        return Outcome(check, State.NOT_RUN, None)
    value = metrics.get(check.metric)
    if value is None:
        return Outcome(check, State.FAILS, None, "the run has no such metric")
    return Outcome(check, State.HOLDS if check.holds_for(value) else State.FAILS, value)


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
