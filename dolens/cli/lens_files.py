"""The commands `dolens convert` and `dolens check`, about lens files of any format."""

import os
from pathlib import Path
from typing import Annotated

import typer


def convert(
    old: Annotated[Path, typer.Argument(metavar="A", help="Lens file of any format below.")],
    new: Annotated[
        Path, typer.Argument(metavar="B", help="File to write; its suffix says the format.")
    ],
    index_model: Annotated[
        str | None,
        typer.Option(help="dfc, do or paper, instead of the model that A names."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite B if it exists.")] = False,
) -> None:
    """Convert a lens file to another format, and say what was changed or lost.

    Read and written: dolens's own YAML (.yaml, .yml) and JSON (.json), Zemax (.zmx), CODE V
    (.seq) and dO's text (.txt). Only read: OSLO (.len), and the JSON of Optiland, DeepLens
    and ray-optics (.json, .roa). What a file holds counts, and not its name alone.

    B is read again and compared with A key by key. What its format
    cannot hold is dropped and listed, if it is a name or a remark. If light
    would go another way, the lens is refused and nothing is written.

    Example: dolens convert my_lens.zmx my_lens.yaml
    """
    from rich.console import Console

    from dolens.errors import InputError, readable
    from dolens.prescriptions.conversion import converted
    from dolens.prescriptions.files import read_lens_file

    prescription, passed_over = read_lens_file(old)
    if not force and os.path.lexists(new):
        same = os.path.exists(new) and os.path.exists(old) and new.samefile(old)
        raise InputError(
            f"{new}: {'is A itself' if same else 'exists already'}; --force overwrites it"
        )
    found = converted(prescription, str(old), str(new), index_model)
    changes = list(found.changes)
    if passed_over:
        changes.append(f"passed over in {old.name}: {'; '.join(passed_over)}")
    _write(found.data, new)

    console = Console(highlight=False, soft_wrap=True)
    surfaces = len(found.after.surfaces)
    console.print(
        f"{readable(new)}: written, {surfaces} surface{'s' * (surfaces != 1)}", markup=False
    )
    for change in changes:
        console.print(f"  - {readable(change)}", markup=False)
    if not changes:
        console.print("  nothing was lost or changed", markup=False)
    elif found.same_numbers:
        console.print(
            "  every radius, thickness, index and aperture is the same to the last bit",
            markup=False,
        )


def _write(data: bytes, path: Path) -> None:
    """Write a whole file or none."""
    from dolens.errors import InputError
    from dolens.files import written_whole

    try:
        with written_whole(path) as aside:
            aside.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


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
