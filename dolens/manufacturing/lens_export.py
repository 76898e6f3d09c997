"""A lens is exported: its design, solids and drawings, with what each file is and how exact."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dolens.errors import InputError, check_choice
from dolens.manufacturing.drawings import export_drawings
from dolens.manufacturing.shop_tolerances import ShopTolerances
from dolens.manufacturing.solids_picture import solids_figure
from dolens.manufacturing.step import TOLERANCE_NM, StepResult, export_step
from dolens.optics.lens import Lens
from dolens.plotting.captions import plain_text
from dolens.plotting.export import save_figure
from dolens.prescriptions.files import save_lens

FORMATS = ("yaml", "zmx", "step", "drawing")


@dataclass
class Exported:
    """What an export has written.

    Attributes:
        files: path within the export's folder → what it is, and what is known of its errors.
        refused: format → one sentence that says why there is no such file.
        notes: sentences about what is not in a file.
        step: what is in the STEP file, or None.
    """

    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    step: StepResult | None = None


def export_lens(
    lens: Lens,
    folder: str | Path,
    formats: Sequence[str] = FORMATS,
    tolerances: ShopTolerances | None = None,
    design: str = "",
    program: str = "dolens",
    tolerance_nm: float = TOLERANCE_NM,
    progress: Callable[[str], None] | None = None,
    drawn: Lens | None = None,
) -> Exported:
    """Write a lens in several formats; a format that cannot hold it is refused, the others go on.

    Args:
        lens: any.
        folder: that the files go to; it is made.
        formats: of `FORMATS`.
        tolerances: for the drawings; None: all are to be agreed.
        design: hash of the design, for the title blocks.
        program: name and version, for the title blocks.
        tolerance_nm: the largest error in sag of the STEP file.
        progress: called with the name of each format before it is written.

    Rarely needed:
        drawn: the lens of the drawings, where it alone has the elements that tolerances are of.

    Raises:
        InputError: a format of another name.
    """
    for name in formats:
        check_choice(name, FORMATS, "format")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    exported = Exported()
    known = tolerances or ShopTolerances()
    writers: dict[str, Callable[[], None]] = {
        "yaml": lambda: _design(exported, lens, folder / "lens.yaml"),
        "zmx": lambda: _design(exported, lens, folder / "lens.zmx"),
        "step": lambda: _solids(exported, lens, folder, tolerance_nm),
        "drawing": lambda: _drawings(exported, drawn or lens, folder, known, design, program),
    }
    for name in (each for each in FORMATS if each in formats):
        if progress is not None:
            progress(name)
        try:
            writers[name]()
        except InputError as error:
            exported.refused[name] = str(error).removeprefix(f"{folder}/")
    return exported


def _design(exported: Exported, lens: Lens, path: Path) -> None:
    save_lens(lens, path)
    program = "dolens" if path.suffix == ".yaml" else "Zemax OpticStudio"
    exported.files[path.name] = {
        "is": f"the design, as {program} reads it",
        "error": "none: read back, it gives the same numbers to the last bit",
    }


def _solids(exported: Exported, lens: Lens, folder: Path, tolerance_nm: float) -> None:
    result = export_step(lens, folder / "lens.step", tolerance_nm)
    exported.step = result
    exported.notes += [f"lens.step: left out: {sentence}" for sentence in result.left_out]
    worst = max(error.largest for error in result.errors)
    exported.files["lens.step"] = {
        "is": f"{len(result.elements)} glass elements as solids in their places, mm",
        "error": f"largest error in sag {worst:.3g} nm, measured in the written file",
        "sag_errors": [
            {
                "element": error.element,
                "surface": error.surface,
                "face": error.kind,
                "points": error.points,
                "largest_nm": error.largest,
                "rms_nm": error.rms,
            }
            for error in result.errors
        ],
        "volumes_mm3": dict(result.volumes),
        "left_out": list(result.left_out),
    }
    save_figure(
        solids_figure(result.solids, f"{plain_text(lens.name)}: solids"), folder / "lens_solids.png"
    )
    exported.files["lens_solids.png"] = {"is": "a picture of the solids of lens.step"}


def _drawings(
    exported: Exported,
    lens: Lens,
    folder: Path,
    tolerances: ShopTolerances,
    design: str,
    program: str,
) -> None:
    result = export_drawings(lens, folder, tolerances, design, program)
    exported.notes += [f"drawing: no sheet: {sentence}" for sentence in result.left_out]
    agreed = "" if tolerances.complete else "; what is to be agreed is marked"
    exported.files["drawing.pdf"] = {
        "is": f"{len(result.sheets)} drawing sheets, A4, in the manner of ISO 10110{agreed}",
        "error": "none: its numbers are the design's, rounded as printed",
    }
    for path in result.sheets:
        exported.files[f"drawing/{path.name}"] = {"is": "the same sheet as SVG"}
