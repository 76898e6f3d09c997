"""`dolens watch`: the page of a run, on this machine alone."""

from pathlib import Path
from typing import Annotated

import typer

from dolens.cli.extras import import_extra, quiet_logging
from dolens.cli.local_page import Port
from dolens.errors import InputError, readable
from dolens.files import resolved_path


def watch(
    run: Annotated[Path, typer.Argument(help="The folder of a run.", metavar="RUN")],
    port: Port = None,
    idle: Annotated[
        float | None,
        typer.Option(
            metavar="<minutes>",
            help="End when the run has ended and nobody has looked at the page for so long; by "
            "default Ctrl-C ends it.",
        ),
    ] = None,
) -> None:
    """Show a run on a page: while it works, when it has ended, and through its history.

    Section, spots and variables of a design, photographs of a camera, the best forms of a search,
    and the curves of all numbers, with a scrubber through the recorded steps. The page is served on
    this machine alone, under an address with a random token, and reads the run folder only.

    Example: dolens watch outputs/nikon/2026-11-28_12-00-00
    """
    quiet_logging()
    if idle is not None and not 0.0 < idle < 1e6:
        raise InputError(f"--idle: {idle:g}; allowed: above 0, minutes")
    folder = resolved_path(run)
    if not folder.is_dir():
        raise InputError(f"{run}: is no folder of a run")
    module = import_extra("dolens.experiments.watch.server", "live", "dolens watch")
    server = module.WatchServer(folder, port)
    typer.echo(f"{readable(folder)}: {server.address}")
    server.run(None if idle is None else 60.0 * idle)
