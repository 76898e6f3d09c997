"""The command `dolens show`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

    from dolens.lens_page.tables import Table
    from dolens.optics.lens import Lens


LensFile = Annotated[
    str,
    typer.Argument(
        help="A lens file (.yaml, .json, .zmx, .seq, .len, .roa, .txt), or the name of a "
        "lens of dolens."
    ),
]


def show(
    lens: LensFile,
    html: Annotated[
        Path | None,
        typer.Option(help="Write a page of figures and tables to this file; it needs no network."),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Write every figure as PNG and SVG into this folder.")
    ] = None,
    tolerances: Annotated[
        str | None,
        typer.Option(
            metavar="<default|file>",
            help="Add the worst offenders among tolerances: of a YAML file, or usual ones.",
        ),
    ] = None,
    ghosts: Annotated[
        bool,
        typer.Option(
            "--ghosts", help="Add the ghosts of a source at each field: light reflected twice."
        ),
    ] = False,
    field: Annotated[
        list[str] | None,
        typer.Option(
            metavar="<x,y>",
            help="A field: degrees, or mm on a near object; one number is along y. Repeatable.",
        ),
    ] = None,
    wavelength: Annotated[
        list[float] | None, typer.Option(metavar="<nm>", help="A wavelength. Repeatable.")
    ] = None,
    f_number: Annotated[float | None, typer.Option(help="Set the stop to this F-number.")] = None,
    entrance_pupil: Annotated[
        float | None,
        typer.Option(metavar="<mm>", help="Set the stop to this entrance pupil diameter."),
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(
            metavar="<name>", help="Show the lens in this state, of a lens that zooms or focuses."
        ),
    ] = None,
    index_model: Annotated[
        str | None, typer.Option(help="dfc, do or paper, instead of the file's own.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite a file that is no page of dolens.")
    ] = False,
) -> None:
    """Show a lens: its prescription, first-order data, aberrations and spots.

    Fields, wavelengths and aperture are the file's own where no option says otherwise.  States of a
    lens that zooms or focuses are listed.

    Example: dolens show cooke_triplet --field 0 --field 0,14 --html page.html
    """
    started = time.perf_counter()
    from rich.console import Console

    from dolens.errors import InputError
    from dolens.files import check_written
    from dolens.lens_page.overview import lens_overview, prepared_lens
    from dolens.optics.text_tables import printable
    from dolens.prescriptions import lens_from_prescription
    from dolens.prescriptions.files import find_lens, read_lens_file, read_yaml_file

    if tolerances is not None and html is None and figures is None:
        raise InputError("--tolerances needs --html or --figures, where its figure goes")
    if html is not None:
        _check_page(html, Path(lens), force)
    check_written(figures, "--figures", folder=True)
    if tolerances is not None and tolerances != "default":
        read_yaml_file(tolerances, "file of tolerances", "--tolerances")
    fields = None if not field else [_field(text) for text in field]
    path = find_lens(lens)
    prescription, passed_over = read_lens_file(path)
    shown = prepared_lens(
        lens_from_prescription(prescription, index_model=index_model, where=str(path)).in_state(
            state
        ),
        fields,
        wavelength or None,
        f_number,
        entrance_pupil,
    )
    console = Console(highlight=False)
    overview = lens_overview(shown, ghosts)
    console.print()
    console.print(printable(overview.name), style="bold", markup=False)
    console.print(overview.summary, style="dim", markup=False)
    if passed_over:
        console.print(
            f"passed over: {printable('; '.join(passed_over))}", style="dim", markup=False
        )
    for section in overview.sections:
        console.print()
        console.print(section.title, style="bold cyan", markup=False)
        for note in section.problems:
            console.print(note, style="yellow", markup=False)
        for table in section.tables:
            _print_table(console, table)
    if html is not None or figures is not None:
        _write(console, shown, html, figures, tolerances, ghosts, started)


def _field(text: str) -> tuple[float, float]:
    from dolens.errors import InputError

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise InputError(f"--field: must be a number (y) or two (x,y), not '{text}'")
    return (0.0, numbers[0]) if len(numbers) == 1 else (numbers[0], numbers[1])


def _check_page(page: Path, lens: Path, force: bool) -> None:
    """Refuse to write a page over something else before work begins."""
    from dolens.errors import InputError
    from dolens.files import check_written
    from dolens.lens_page.page import is_page

    if page.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--html: a page's file ends in .html, not '{page.name}'")
    if not page.absolute().parent.is_dir():
        raise InputError(f"--html: there is no folder '{page.parent}'")
    if page.is_dir():
        raise InputError(f"--html: '{page}' is a folder")
    if page.exists() and not force and not is_page(page):
        raise InputError(f"--html: {page} is no page of dolens; --force overwrites it")
    check_written(page, "--html")


def _print_table(console: "Console", table: "Table") -> None:
    """Print a table; one wider than the terminal goes on below, each part with its first column."""
    from dolens.optics.text_tables import printable

    def least(columns: list[int]) -> int:
        wide = console.options.update(max_width=1000)
        found = console.measure(_rich_table(table, columns), options=wide)
        # Lists may go on in further lines; all else is printed as long as it is.
        return found.minimum if table.listed & {*columns} else found.maximum

    parts = [[0]]
    for column in range(1, len(table.heads)):
        if len(parts[-1]) > 1 and least([*parts[-1], column]) > console.width:
            parts.append([0])
        parts[-1].append(column)
    for number, columns in enumerate(parts):
        if number:
            console.print()
        # Where one column alone is too wide lines break: a cut number would look like another one.
        width = max(console.width, least(columns))
        console.print(_rich_table(table, columns), width=width, crop=False, no_wrap=True)
    if table.caption:
        console.print(printable(table.caption), style="dim", markup=False)


def _rich_table(table: "Table", columns: list[int]) -> "RichTable":
    """Return some columns of a table for the terminal."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    from dolens.optics.text_tables import printable

    shown = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1))
    for column in columns:
        words = column in table.words
        shown.add_column(
            Text(table.heads[column]),
            justify="left" if words else "right",
            no_wrap=not words or (table.numbered and column not in table.listed),
            overflow="fold",
        )
    last = len(table.rows) - 1
    for number, row in enumerate(table.rows):
        total = table.total and number == last
        if total:
            shown.add_section()
        style = "bold" if total or number in table.lit else None
        shown.add_row(*(Text(printable(row[column])) for column in columns), style=style)
    return shown


def _write(
    console: "Console",
    shown: "Lens",
    html: Path | None,
    figures: Path | None,
    tolerances: str | None,
    ghosts: bool,
    started: float,
) -> None:
    import shlex
    import sys

    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from dolens.errors import readable
    from dolens.lens_page.page import write_page

    progress = Progress(
        TextColumn("{task.description:<34}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    )
    console.print()
    with progress:
        task = progress.add_task("")

        def report(title: str, done: int, total: int) -> None:
            progress.update(task, description=title, completed=done, total=total)

        written = write_page(
            shown,
            html,
            figures=figures,
            tolerances=tolerances,
            ghosts=ghosts,
            command=shlex.join(["dolens", *sys.argv[1:]]),
            progress=report,
        )
    seconds = time.perf_counter() - started
    for title, problem in written.problems:
        console.print(f"{title}: {problem}", style="yellow", markup=False)
    if html is not None:
        size = html.stat().st_size
        console.print(
            f"{readable(html)}: written, {written.sections} sections, {size / 1e6:.1f} MB",
            markup=False,
        )
    if figures is not None:
        console.print(
            f"{readable(figures)}: {written.figures} figures, each as PNG and SVG", markup=False
        )
    console.print(f"in {seconds:.1f} s", style="dim", markup=False)
