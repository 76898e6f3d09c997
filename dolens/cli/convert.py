"""The command `dolens convert`."""

import os
import tempfile
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

    name = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".dolens-", delete=False) as file:
            name = file.name
            file.write(data)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, path)
    except OSError as error:
        if name is not None and os.path.exists(name):
            os.unlink(name)
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
