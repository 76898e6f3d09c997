"""`dolens mcp`: a server of the Model Context Protocol, for programs that design lenses."""

from pathlib import Path
from typing import Annotated

import typer

from dolens.cli.extras import import_extra, quiet_logging


def mcp(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="The one folder that files are read from and written to."
        ),
    ],
    seconds: Annotated[
        float, typer.Option(help="A call that takes longer is stopped and answered with one line.")
    ] = 120.0,
) -> None:
    """Let a program design lenses: a server of the Model Context Protocol over stdio.

    A language model's client starts this command and calls its tools: load, show, trace, analyse,
    optimize, search, check, tolerance, photograph, export. Each answers with numbers, their errors
    and a picture. It reads and writes nothing outside of FOLDER, and runs no code from files.

    Example: dolens mcp lenses
    """
    from dolens.errors import InputError

    if not 1.0 <= seconds <= 3600.0:
        raise InputError(f"--seconds: {seconds:g}; allowed: 1 to 3600")
    quiet_logging()
    import_extra("dolens.mcp.server", "mcp", "dolens mcp").serve(folder, seconds)
