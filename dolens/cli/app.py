"""The command `dolens` and its list of commands.

A command's own file imports what it needs when it runs, so that `dolens --help` answers at once and
the commands about a lens work without the packages that training needs.
"""

import io
import sys
from typing import Annotated

import typer

from dolens.cli.apply import apply
from dolens.cli.compare import compare
from dolens.cli.doctor import doctor
from dolens.cli.evaluate import evaluate
from dolens.cli.experiments import experiments
from dolens.cli.export import export
from dolens.cli.lens_files import check, convert
from dolens.cli.mcp import mcp
from dolens.cli.new import new
from dolens.cli.play import play
from dolens.cli.report import HELP as REPORT_HELP
from dolens.cli.report import report
from dolens.cli.show import show
from dolens.cli.train import PassedOn, train
from dolens.cli.watch import watch
from dolens.errors import InputError, one_line
from dolens.files import installed_version
from dolens.threads import limit_threads

app = typer.Typer(
    name="dolens",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command; a user's mistake ends it with one line and exit status 1.

    A file that the system refuses to open, name or write is such a mistake too.
    """
    for stream in (sys.stdout, sys.stderr):
        # Names of files may hold what no terminal shows.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        app()
    except InputError as error:
        sys.exit(f"error: {one_line(error)}")
    except OSError as error:
        if error.filename is None:
            raise
        sys.exit(f"error: {InputError(f'{error.filename}: {error.strerror}')}")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dolens {installed_version('dolens')}")
        raise typer.Exit


@app.callback()
def _dolens(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Look at lenses, design them, and train cameras: optics and reconstruction together."""
    # Each command keeps to the processors that it may use.
    if context.invoked_subcommand != "train":
        limit_threads()


# In the order of `dolens --help`: a lens, an experiment, a run.
app.command("show")(show)
app.command("play")(play)
app.command("convert")(convert)
app.command("check")(check)
app.command("mcp")(mcp)
app.command("new")(new)
app.command("experiments")(experiments)
app.command("train", cls=PassedOn, add_help_option=False)(train)
app.command("watch")(watch)
app.command("evaluate")(evaluate)
app.command("apply")(apply)
app.command("compare")(compare)
app.command("export")(export)
app.command("report", help=REPORT_HELP)(report)
app.command("doctor")(doctor)
