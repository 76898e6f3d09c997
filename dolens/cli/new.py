"""The command `dolens new`."""

import re
from pathlib import Path
from typing import Annotated

import typer

_TEMPLATES = Path(__file__).parent / "new_camera"
# A file among the templates → where it goes; {name} is that of the camera.
_FILES = {
    "lens.yaml": "conf/lens/my_singlet.yaml",
    "network.yaml": "conf/network/residual.yaml",
    "experiment.yaml": "conf/experiment/{name}.yaml",
    "residual_network.py": "residual_network.py",
}


def new(
    folder: Annotated[
        Path, typer.Argument(help="A folder that is empty or does not exist: my_camera.")
    ],
) -> None:
    """Write the files of a camera of your own: a lens, a network and an experiment, ready to train.

    Example: dolens new my_camera
    """
    from dolens.errors import InputError, readable

    name = folder.absolute().name
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InputError(
            f"new: the folder's name is that of the experiment: letters, digits and '_', with a "
            f"letter first, not '{name}'"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"new: {folder} is not an empty folder; nothing was written")
    for template, place in _FILES.items():
        path = folder / place.format(name=name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text((_TEMPLATES / template).read_text("utf-8"), "utf-8")
        typer.echo(readable(path))
    if folder.absolute() != Path.cwd():
        typer.echo(f"\ncd {readable(folder)}")
    typer.echo(f"dolens show conf/lens/my_singlet.yaml\ndolens train experiment={name}")
