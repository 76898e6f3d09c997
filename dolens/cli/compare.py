"""`dolens compare`: one table and one figure of runs, whatever was changed between them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dolens.cli.extras import import_extra
from dolens.errors import InputError
from dolens.files import check_written

_LONGEST_HEADING = 12


def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(help="Run folders, folders of sweeps, or folders that hold any of these."),
    ],
    against: Annotated[
        str | None,
        typer.Option(
            help="Also show what each row gains over this one: its number, its experiment, or its "
            "settings, as network=unet."
        ),
    ] = None,
    judge: Annotated[
        str | None, typer.Option(help="Whose test scores: wave for test_wave/...")
    ] = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option(
            help="Metrics to show, separated by commas: names, patterns (test/psnr_db/*), or "
            "psnr_db for all views of test/psnr_db. Without it: objective, main scores, costs."
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="Write the table as CSV; - prints it instead.")
    ] = None,
    as_json: Annotated[
        Path | None, typer.Option("--json", help="Write everything as JSON; - prints it instead.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(help="Write the tables as Markdown; - prints them instead.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Write the figure: .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Compare runs: a row for all that differ in nothing but the seed, what differs as columns."""
    for option, file in (("csv", csv), ("json", as_json), ("markdown", markdown)):
        check_written(None if str(file) == "-" else file, f"--{option}")
    check_written(figure, "--figure")
    if figure is not None and figure.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"--figure: '{figure.name}'; allowed: a name in .png, .svg or .pdf")
    module = import_extra("dolens.experiments.comparison.comparison", "train", "dolens compare")
    wanted = [name.strip() for text in metrics or () for name in text.split(",") if name.strip()]
    found = module.compared(folders, wanted, against, judge)
    texts = (
        (csv, lambda: module.csv_of(found)),
        (as_json, lambda: json.dumps(module.plain(found), indent=2) + "\n"),
        (markdown, lambda: module.markdown_of(found)),
    )
    printed = False
    for file, text in texts:
        if file is not None and str(file) == "-":
            typer.echo(text(), nl=False)
            printed = True
        elif file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text(), encoding="utf-8")
    if figure is not None:
        from dolens.plotting import save_figure

        save_figure(module.figure_of(found), figure)
    if not printed:
        _show(module, found)


def _show(module: Any, found: Any) -> None:
    console = Console(highlight=False)
    console.print(f"\n[bold]{escape(found.title())}[/]")
    cells = [found.heading(), *(found.cells(row) for row in found.rows.rows)]
    settings, metrics = len(found.rows.columns), len(found.metrics)
    shown = fitting([list(column) for column in zip(*cells, strict=True)], settings, console.width)
    table = _table()
    for place in shown:
        name = _folded(cells[0][place])
        table.add_column(name, justify="left" if 0 < place <= settings else "right")
    for row in cells[1:]:
        table.add_row(*(escape(row[place]) for place in shown))
    console.print(table)
    if found.against is not None:
        console.print(
            f"\n[bold]Gains over row {found.against.number}[/] ({escape(found.against.label)})"
        )
        gains = _table()
        for name in module.GAIN_HEADING:
            gains.add_column(name, justify="left" if name in ("metric", "gain") else "right")
        for line in module.gain_cells(found):
            gains.add_row(*map(escape, line))
        console.print(gains)
    explanation = module.explanation(found)
    if explanation:
        console.print(f"[dim]{escape(explanation)}[/]")
    hidden = [name for place, name in enumerate(cells[0]) if place not in shown]
    if hidden:
        console.print(
            f"[dim]{len(hidden)} of {settings + metrics} columns do not fit here; --csv - and "
            f"--markdown - have all: {escape(', '.join(hidden))}[/]"
        )
    for note in found.notes():
        console.print(f"[yellow]![/] {escape(note)}")


def fitting(columns: Sequence[Sequence[str]], settings: int, width: int) -> list[int]:
    """Return the columns that fit into a terminal, in their order.

    The row's number, the first setting, the count of seeds and the first metric always stay;
    further metrics go before further settings.

    Args:
        columns: the texts of each, the heading first: number, settings, seeds, metrics.
        settings: how many columns are settings.
        width: of the terminal.
    """
    widths = [
        2
        + max(len(line) for text in (_folded(column[0]), *column[1:]) for line in text.split("\n"))
        for column in columns
    ]
    seeds = settings + 1
    wanted = [0, *([1] if settings else []), seeds, seeds + 1]
    others = [*range(2, settings + 1), *range(seeds + 2, len(columns))]
    for place in others:
        if sum(widths[w] for w in (*wanted, place)) <= width:
            wanted.append(place)
    return sorted(wanted)


def _folded(name: str) -> str:
    """Return a heading in lines, one for each part of a metric's name."""
    return escape(name).replace("/", "/\n") if len(name) > _LONGEST_HEADING else escape(name)


def _table() -> Table:
    return Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
