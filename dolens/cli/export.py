"""`dolens export`: a lens or a run in the files that a workshop and other programs take."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dolens.cli.extras import TRUST, import_extra, quiet_logging

if TYPE_CHECKING:
    from rich.console import Console

    from dolens.manufacturing.lens_export import Exported

_LENS = ("yaml", "zmx", "step", "drawing")
_NETWORK = ("torch", "onnx")
_WORDS = {
    "yaml": "the design as YAML",
    "zmx": "the design for Zemax",
    "step": "the glass as solids (STEP)",
    "drawing": "the drawings",
    "torch": "the network by torch.export",
    "onnx": "the network as ONNX",
}


def export(
    run_or_lens: Annotated[
        str,
        typer.Argument(
            help="The folder of a run, or a lens: a file (.yaml, .txt, .zmx), or the name of a "
            "lens of dolens.",
            metavar="RUN|LENS",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; by default RUN/export, or LENS_export here."),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="<formats>",
            help="Only these of yaml, zmx, step, drawing, torch, onnx, with commas between. One "
            "that is not possible is then an error; without --only the others are written.",
        ),
    ] = None,
    checkpoint: Annotated[
        str, typer.Option(help="Of the run: last, best, or the path of a file.")
    ] = "last",
    tolerances: Annotated[
        str | None,
        typer.Option(
            metavar="<file>",
            help="Tolerances for the drawings: a YAML file with 'tolerances' as an experiment has "
            "them, and 'drawing' for form, imperfections, coating and so on. What is not given is "
            "marked as to be agreed.",
        ),
    ] = None,
    image_size: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="<rows> <columns>",
            help="Of the pictures that the network takes; by default the run's sensor. Only a "
            "network that deconvolves, or one of your own, is bound to it.",
        ),
    ] = None,
    multiple_of: Annotated[
        int | None,
        typer.Option(help="A network of your own takes any sides that are a multiple of this."),
    ] = None,
    sag_nm: Annotated[
        float, typer.Option(help="Largest error in sag of the STEP file, nm; at most 10.")
    ] = 10.0,
    trust: Annotated[bool, typer.Option("--trust", help=TRUST)] = False,
) -> None:
    """Write a lens, or the lens and the network of a run, in files for others.

    The design as YAML and for Zemax; the glass as solids in a STEP file, whose surfaces are read
    back and measured; drawings in the manner of ISO 10110; the network by torch.export and as ONNX,
    both checked. What each file is, and how exact, is in export.json.

    Example: dolens export cooke_triplet --only step,drawing
    """
    from rich.console import Console

    from dolens.errors import InputError, check_choice, readable
    from dolens.files import check_written, resolved_path

    if not 0.0 < sag_nm <= 10.0:
        raise InputError(f"--sag-nm: must be above 0 and at most 10, not {sag_nm:g}")
    check_written(out, "--out", folder=True)
    resolved_path(run_or_lens)
    quiet_logging()
    console = Console(highlight=False)
    is_run = Path(run_or_lens).is_dir()
    known = (*_LENS, *_NETWORK) if is_run else _LENS
    formats = known if only is None else tuple(name.strip() for name in only.split(","))
    for name in formats:
        check_choice(name, (*_LENS, *_NETWORK), "--only")
        if name not in known:
            raise InputError(f"--only: {run_or_lens} is a lens, and has no network for '{name}'")
    with console.status("") as status:

        def progress(name: str) -> None:
            status.update(f"writing {_WORDS[name]}")

        if is_run:
            module = import_extra("dolens.experiments.commands.export", "train", "dolens export")
            settings = module.ExportSettings(
                formats, checkpoint, tolerances, image_size, multiple_of, sag_nm, trust
            )
            folder, exported = module.export_run(run_or_lens, out, settings, progress)
        else:
            from dolens.manufacturing.lens_export import export_lens_file

            folder, exported = export_lens_file(
                run_or_lens, out, formats, tolerances, sag_nm, progress
            )
    _show(console, exported)
    console.print(readable(folder), markup=False)
    if only is not None and exported.refused:
        raise typer.Exit(1)


def _show(console: "Console", exported: "Exported") -> None:
    from rich.table import Table

    if exported.step is not None:
        table = Table("solid", "surface", "face", "largest error (nm)", "RMS (nm)", box=None)
        for error in exported.step.errors:
            row = (error.element, str(error.surface), error.kind)
            table.add_row(*row, f"{error.largest:.2g}", f"{error.rms:.2g}")
        console.print("Sag of the surfaces in lens.step, measured against the lens", style="bold")
        console.print(table)
        console.print()
    table = Table("file", "what it is", "error", box=None)
    for name, facts in exported.files.items():
        if not name.startswith("drawing/"):
            sizes = f"; {facts['sizes']}" if "sizes" in facts else ""
            table.add_row(name, facts["is"] + sizes, facts.get("error", ""))
    if table.row_count:
        console.print(table)
    for sentence in exported.notes:
        console.print(sentence, style="yellow", markup=False)
    for name, reason in exported.refused.items():
        console.print(f"not written: {_WORDS[name]}: {reason}", style="yellow", markup=False)
