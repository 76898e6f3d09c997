"""A lens file is exported, without any run."""

from collections.abc import Callable, Sequence
from pathlib import Path

from dolens.manufacturing.design_files import design_hash
from dolens.manufacturing.export_record import program_name, write_record
from dolens.manufacturing.lens_export import FORMATS, Exported, export_lens
from dolens.manufacturing.shop_tolerances import ShopTolerances, read_tolerances
from dolens.manufacturing.step import TOLERANCE_NM
from dolens.prescriptions.files import load_lens


def export_lens_file(
    file: str | Path,
    folder: str | Path | None = None,
    formats: Sequence[str] = FORMATS,
    tolerances: str | None = None,
    tolerance_nm: float = TOLERANCE_NM,
    progress: Callable[[str], None] | None = None,
) -> tuple[Path, Exported]:
    """Export a lens file; see `export_lens`.

    Args:
        file: of the lens, or the name of a lens of dolens.
        folder: for the files; None: the lens's name and `_export` in the working folder.
        formats: of `FORMATS`.
        tolerances: a file of tolerances for the drawings; None: all are to be agreed.
        tolerance_nm: the largest error in sag of the STEP file.
        progress: called with the name of each format before it is written.

    Returns:
        The folder, and what is in it.

    Raises:
        InputError: the lens or the tolerances cannot be read, or an unknown format.
    """
    lens = load_lens(file).requires_grad_(False)
    drawn, known = lens, ShopTolerances()
    if tolerances is not None:
        drawn, known = read_tolerances(lens, tolerances)
    folder = Path(f"{Path(file).stem}_export") if folder is None else Path(folder)
    design = design_hash(lens)
    exported = export_lens(
        lens, folder, formats, known, design, program_name(), tolerance_nm, progress, drawn
    )
    write_record(folder, lens, exported, {"lens": Path(file).name})
    return folder, exported
