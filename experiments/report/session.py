"""The report is made: what is missing is run, one system after another, and the page written."""

import datetime
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import dolens
from dolens.experiments.report.checks import Material, Outcome, load_checks, outcomes
from dolens.experiments.report.page import page
from dolens.experiments.report.plan import Plan, System
from dolens.experiments.report.runs import (
    RECORD,
    Finish,
    code_fingerprint,
    compared,
    is_current,
    last_words,
    read_result,
    run_system,
)
from dolens.experiments.running.run_files import is_finished, read_json

PAGE = "index.html"
RUNS = "runs"


class Announcer(Protocol):
    """What shows a user how far the report is."""

    def taken(self, system: System, folder: Path) -> None:
        """Say that a finished run is taken as it is."""

    def started(self, system: System, number: int, count: int) -> None:
        """Say that a run begins, the n-th of so many."""

    def tick(self, elapsed: float, remaining: float) -> None:
        """Show the seconds of the current run, and those that all runs still take."""

    def ended(self, system: System, finish: Finish) -> None:
        """Say how a run ended."""


@dataclass(frozen=True)
class Choice:
    """What is to be run.

    Attributes:
        only: names of systems; empty for all of them.
        given: name → finished run of the user's own, taken whatever its settings.
        again: run systems that are finished too.
        any_code: take finished runs by other versions of the code too.
        no_run: run nothing.
    """

    only: tuple[str, ...] = ()
    given: Mapping[str, Path] = field(default_factory=dict)
    again: bool = False
    any_code: bool = False
    no_run: bool = False


@dataclass(frozen=True)
class Report:
    """What was made.

    Attributes:
        page: the file.
        outcomes: of all checks.
        failed: systems whose run ended with an error.
        missing: systems without a finished run.
    """

    page: Path
    outcomes: tuple[Outcome, ...]
    failed: tuple[str, ...]
    missing: tuple[str, ...]


def make_report(plan: Plan, folder: Path, choice: Choice, announcer: Announcer) -> Report:
    """Run what is to be run, and write the page from all finished runs.

    A run that fails does not end the report.  When the user interrupts a run, the page is written
    from what is finished; the same call later goes on with the rest.

    Args:
        plan: systems and items.
        folder: of the report; runs lie in `runs/<system>`, the page is `index.html`.
        choice: what is to be run.
        announcer: is told how far the report is.

    Raises:
        InputError: an unknown name, or expected values that name what there is not.
        KeyboardInterrupt: the user stopped it; the page is written.
    """
    wanted = [plan.system(name) for name in choice.only] or list(plan.systems)
    load_checks(plan)  # a mistake there is told before the runs, and not after them
    waiting = []
    for system in wanted:
        own = folder / RUNS / system.name
        if system.name in choice.given:
            announcer.taken(system, choice.given[system.name])
        elif not choice.again and is_current(system, own, choice.any_code or choice.no_run):
            announcer.taken(system, own)
        elif not choice.no_run:
            waiting.append(system)
    try:
        _run_all(waiting, folder / RUNS, announcer)
    finally:
        report = _written(plan, folder, choice.given)
    return report


def _run_all(systems: Sequence[System], runs: Path, announcer: Announcer) -> None:
    pace = Pace()
    for number, system in enumerate(systems):
        announcer.started(system, number + 1, len(systems))
        later = [other.seconds for other in systems[number + 1 :]]

        def tick(elapsed: float, system: System = system, later: list[float] = later) -> None:
            announcer.tick(elapsed, pace.remaining(system.seconds, elapsed, later))

        finish = run_system(system, runs / system.name, tick)
        if finish.status == 0:
            pace.finished(system.seconds, finish.wall_s)
        announcer.ended(system, finish)


def _written(plan: Plan, folder: Path, given: Mapping[str, Path]) -> Report:
    """Write the page from every finished run that there is."""
    folders, failed = dict(given), {}
    for system in plan.systems:
        own = folder / RUNS / system.name
        if system.name in folders:
            continue
        if is_current(system, own, any_code=True):
            folders[system.name] = own
        elif _status(own) not in (None, 0) and not is_finished(own):
            failed[system.name] = last_words(own.with_name(f"{own.name}.log"))
    page = folder / PAGE
    found = assemble(plan, folders, failed, page)
    missing = tuple(s.name for s in plan.systems if s.name not in {**folders, **failed})
    return Report(page, found, tuple(failed), missing)


def _status(folder: Path) -> int | None:
    """Return the exit status of a run by the report; None where it has not ended."""
    return read_json(folder / RECORD).get("status")


def assemble(
    plan: Plan, folders: Mapping[str, Path], failed: Mapping[str, str], file: Path
) -> tuple[Outcome, ...]:
    """Write the page, and return the outcomes of all checks.

    Args:
        plan: systems and items.
        folders: finished runs by the names of their systems.
        failed: systems whose run ended with an error → what it said last.
        file: of the page; its folder is made.

    Raises:
        InputError: a folder is not that of a finished run, or a plan or expected values are wrong.
    """
    results = {name: read_result(name, folder) for name, folder in folders.items()}
    comparisons = compared(plan.comparisons, results)
    metrics = {name: result.metrics for name, result in results.items()} | comparisons
    found = outcomes(load_checks(plan), metrics)
    material = Material(plan, results, comparisons, found, failed, _made(), code_fingerprint())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page(material, file.parent), encoding="utf-8")
    return found


def _made() -> str:
    now = datetime.datetime.now().astimezone()
    version = getattr(dolens, "__version__", None)
    of = f"dolens {version}, code {code_fingerprint()}" if version else f"code {code_fingerprint()}"
    return f"Made on {now:%-d %B %Y at %H:%M} by {of}."


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
