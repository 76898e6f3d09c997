"""The command `dolens check`."""

from pathlib import Path
from typing import Annotated

import typer


def check(
    folder: Annotated[
        Path, typer.Argument(help="A folder; all lens files in it and below. Or one file.")
    ],
    suffix: Annotated[
        list[str] | None,
        typer.Option("--format", metavar="<.zmx>", help="Files of this format only. Repeatable."),
    ] = None,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print files and summary as JSON.")
    ] = False,
) -> None:
    """Check which lens files load, and say why the others do not.

    One line a file: whether it loads and what is passed over in it, or why it is refused. A table
    then counts the reasons. The exit status is 1 if any file is refused.

    Example: dolens check lenses --format .zmx
    """
    import json

    from dolens.errors import readable
    from dolens.prescriptions.files import as_data, check_files, lens_files, summary

    files = lens_files(folder, suffix or ())
    found = []
    for done in check_files(files):
        found.append(done)
        if json_output:
            continue
        name = done.path if folder.is_file() else str(Path(done.path).relative_to(folder))
        said = f"passed over: {'; '.join(done.passed_over)}" if done.passed_over else ""
        status = "loads" if done.loads else "refused"
        typer.echo(readable(f"{status:8}{name}: {done.reason or said}").rstrip(": "))
    if json_output:
        typer.echo(json.dumps(as_data(found), indent=2, ensure_ascii=False))
    else:
        loaded = sum(done.loads for done in found)
        typer.echo(f"\n{loaded} of {len(found)} files load")
        for form, reason, count in summary(found):
            typer.echo(f"{count:6}  {form:6}  {f'refused: {reason}' if reason else 'loads'}")
    if not all(done.loads for done in found):
        raise typer.Exit(1)
