"""`dolens report`: every system of the supplement run, and compared with what is printed."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer

from dolens.cli.extras import import_extra
from dolens.errors import readable
from dolens.files import check_written

_PACKAGE = "dolens.experiments.report"
# A paragraph a line: the terminal wraps them.
HELP = "\n\n".join(
    (
        "Run every system of the dO supplement, and write one page that compares it with what is "
        "printed.",
        "The page is outputs/report/index.html. For each equation, table and figure it has the "
        "printed number, ours, why they differ, cost, error, pictures and the command. At its top "
        "are checks against expected values.",
        "A system that is finished with the same settings and code is not run again; after Ctrl-C "
        "the same command goes on. All systems together take about twenty minutes on two cores.",
        "The exit status is 1 if a check does not hold or a run fails. Checks of systems that were "
        "not run do not count.",
    )
)


def report(
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Run only these systems: a name, or several with commas. Repeatable.",
        ),
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FOLDER",
            help="Take finished runs: a run folder, a folder of run folders, or NAME=FOLDER, which "
            "stands for that system whatever its settings. Repeatable.",
        ),
    ] = None,
    folder: Annotated[
        Path, typer.Option(help="The folder of the report; its runs lie in runs/ there.")
    ] = Path("outputs/report"),
    again: Annotated[bool, typer.Option("--again", help="Run finished systems again.")] = False,
    any_code: Annotated[
        bool, typer.Option("--any-code", help="Take finished runs of other versions of the code.")
    ] = False,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Run nothing; write the page from finished runs.")
    ] = False,
    no_fail: Annotated[
        bool, typer.Option("--no-fail", help="Exit with status 0 even if a check does not hold.")
    ] = False,
    list_systems: Annotated[
        bool, typer.Option("--list", help="List the systems with their cost, and stop.")
    ] = False,
) -> None:
    """Run the report; HELP says what it does."""
    check_written(folder, "--folder", folder=True)
    plan_module = import_extra(f"{_PACKAGE}.plan", "train", "dolens report")
    plan = plan_module.load_plan()
    if list_systems:
        _list(plan)
        return
    results = import_extra(f"{_PACKAGE}.runs", "train", "dolens report")
    session = import_extra(f"{_PACKAGE}.session", "train", "dolens report")
    names = tuple(name for entry in only or () for name in entry.split(",") if name)
    given = results.assigned(plan, runs or ())
    choice = session.Choice(names, given, again, any_code, no_run)
    with _Progress() as progress:
        try:
            made = session.make_report(plan, folder, choice, progress)
        except KeyboardInterrupt:
            progress.stop()
            typer.echo(
                "Stopped. Finished runs are kept and on the page; the same command goes on.",
                err=True,
            )
            raise typer.Exit(130) from None
    failed = _summary(made)
    raise typer.Exit(1 if failed and not no_fail else 0)


class _Progress:
    """Shows the current run, its time, and how long all of them still take."""

    def __init__(self) -> None:
        from rich.console import Console

        self.console = Console(stderr=True, highlight=False)
        self.status: Any = None
        self.line = ""

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        if self.status is not None:
            self.status.stop()
            self.status = None

    def taken(self, system: Any, folder: Path) -> None:
        self.console.print(
            f"{system.name}: finished before, {folder}", markup=False, soft_wrap=True
        )

    def started(self, system: Any, number: int, count: int) -> None:
        self.line = f"[{number}/{count}] {system.name}"
        self.console.print(f"{self.line}: {system.title}", markup=False, soft_wrap=True)
        if self.console.is_terminal:
            self.status = self.console.status("")
            self.status.start()

    def tick(self, elapsed: float, remaining: float) -> None:
        if self.status is not None:
            left = f"about {_duration(remaining)} left" if remaining >= 1.0 else "nearly done"
            self.status.update(f"{_duration(elapsed)}; all runs: {left}")

    def ended(self, system: Any, finish: Any) -> None:
        self.stop()
        took = _duration(finish.wall_s)
        if finish.status == 0:
            self.console.print(f"{self.line}: done in {took}", markup=False, soft_wrap=True)
            return
        runner = import_extra(f"{_PACKAGE}.runs", "train", "dolens report")
        self.console.print(
            f"{self.line}: FAILED after {took} with status {finish.status}; {finish.log} ends with",
            markup=False,
            soft_wrap=True,
        )
        self.console.print(runner.last_words(finish.log), markup=False, soft_wrap=True)


def _list(plan: Any) -> None:
    """Print the systems with the supplement's items that they belong to."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("name", no_wrap=True)
    for heading in ("what", "items", "expected time"):
        table.add_column(heading)
    for system in plan.systems:
        items = ", ".join(item.item for item in plan.items() if system.name in item.runs)
        table.add_row(system.name, system.title, items, _duration(system.seconds))
    console = Console()
    console.print(table)
    total = _duration(sum(system.seconds for system in plan.systems))
    console.print(f"All: {total} of processor time on one core.")


def _summary(made: Any) -> bool:
    """Print what holds and what does not; return whether anything failed."""
    checks = import_extra(f"{_PACKAGE}.checks", "train", "dolens report")
    overview = import_extra(f"{_PACKAGE}.page", "train", "dolens report")
    counts = Counter(outcome.state for outcome in made.outcomes)
    for outcome in made.outcomes:
        if outcome.state is checks.State.FAILS:
            check = outcome.check
            typer.echo(
                f"does not hold: {check.item}: {check.what}: {overview.found_text(outcome)}, "
                f"expected {overview.expected_text(check)} ({check.run}: {check.metric})"
            )
    for name in made.failed:
        typer.echo(f"run failed: {name}")
    if made.missing:
        typer.echo(f"not run: {', '.join(made.missing)}")
    typer.echo(
        f"{counts[checks.State.HOLDS]} checks hold, {counts[checks.State.FAILS]} do not, "
        f"{counts[checks.State.NOT_RUN]} were not run: {readable(made.page)}"
    )
    return bool(counts[checks.State.FAILS] or made.failed)


def _duration(seconds: float) -> str:
    numbers = import_extra(f"{_PACKAGE}.page", "train", "dolens report")
    return numbers.seconds_text(seconds)
