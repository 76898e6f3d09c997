"""A lens is exported: its design, solids and drawings, and a record of what each file is."""

import datetime
import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dolens.errors import InputError, check_choice
from dolens.files import installed_version
from dolens.manufacturing.drawing_numbers import ShopTolerances, read_tolerances
from dolens.manufacturing.drawings import export_drawings
from dolens.manufacturing.solids import solids_figure
from dolens.manufacturing.step import TOLERANCE_NM, StepResult, export_step
from dolens.optics.lens import Lens
from dolens.plotting.export import save_figure
from dolens.plotting.style import plain_text
from dolens.prescriptions.build import prescription_of
from dolens.prescriptions.files import load_lens, save_lens

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


RECORD = "export.json"
_PACKAGES = (
    *("dolens", "numpy", "scipy", "torch", "matplotlib", "cadquery-ocp-novtk"),
    *("onnx", "onnxscript", "onnxruntime"),
)


def program_name() -> str:
    """Return `dolens` and its version."""
    return f"dolens {installed_version('dolens') or ''}".strip()


def write_record(
    folder: str | Path, lens: Lens, exported: Exported, source: dict[str, Any]
) -> Path:
    """Write export.json, and return its path.

    Args:
        folder: of the export.
        lens: that was exported.
        exported: what was written.
        source: where the lens is from: plain values.
    """
    folder = Path(folder)
    files = {
        name: {**facts, "bytes": (folder / name).stat().st_size, "sha256": file_hash(folder / name)}
        for name, facts in exported.files.items()
    }
    record = {
        "lens": lens.name,
        "source": source,
        "design_sha256": design_hash(lens),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "files": files,
        "not_written": exported.refused,
        "notes": exported.notes,
        "versions": {
            "python": platform.python_version(),
            **{
                name: version
                for name in _PACKAGES
                if (version := installed_version(name)) is not None
            },
        },
    }
    path = folder / RECORD
    path.write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def design_hash(lens: Lens) -> str:
    """Return the SHA-256 of a lens's prescription: equal for the same numbers, to the last bit."""
    text = json.dumps(prescription_of(lens), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
