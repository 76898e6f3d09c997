"""A run is exported: its design, and its network."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from dolens.errors import InputError, check_choice
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.network_export import FORMATS as NETWORK_FORMATS
from dolens.experiments.camera.network_export import export_onnx, export_torch, exportable
from dolens.experiments.running.finished_run import FinishedRun, load_run
from dolens.experiments.running.trust import own_folder
from dolens.manufacturing.drawing_numbers import ShopTolerances, drawn_labels, read_tolerances
from dolens.manufacturing.lens_export import FORMATS as LENS_FORMATS
from dolens.manufacturing.lens_export import (
    Exported,
    design_hash,
    export_lens,
    program_name,
    write_record,
)
from dolens.manufacturing.step import TOLERANCE_NM
from dolens.optics.lens import Lens
from dolens.tolerancing import tolerances_from

FORMATS = (*LENS_FORMATS, *NETWORK_FORMATS)


@dataclass(frozen=True)
class ExportSettings:
    """How a run is exported.

    Attributes:
        formats: of `FORMATS`.
        checkpoint: `last`, `best`, or the path of a file.
        tolerances: a file of tolerances for the drawings; None: the run's own, if it has any.
        size: rows and columns of the network's images; None: the sensor's.
        multiple: that sides are a multiple of; None: what is known of the network.
        tolerance_nm: the largest error in sag of the STEP file.
        trust: whether the run may call, import and write what it names; see `load_run`.
    """

    formats: Sequence[str] = FORMATS
    checkpoint: str = "last"
    tolerances: str | None = None
    size: tuple[int, int] | None = None
    multiple: int | None = None
    tolerance_nm: float = TOLERANCE_NM
    trust: bool = False


def export_run(
    run: str | Path,
    folder: str | Path | None = None,
    settings: ExportSettings | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Path, Exported]:
    """Write a run's lens as the checkpoint has it, its drawings and its network.

    Args:
        run: the run folder.
        folder: for the files; None: `export` within the run folder.
        settings: None: all formats.
        progress: called with the name of each format before it is written.

    Returns:
        The folder, and what is in it; a format that is not possible is in `refused`.

    Raises:
        InputError: the run cannot be loaded, or an unknown format or wrong tolerances.
    """
    settings = settings or ExportSettings()
    for name in settings.formats:
        check_choice(name, FORMATS, "format")
    folder = Path(folder) if folder is not None else own_folder(run, "export")
    loaded = load_run(run, settings.checkpoint, with_loss=False, trust=settings.trust)
    lens = copy.deepcopy(loaded.lens).double().cpu()
    design = design_hash(lens)
    drawn, tolerances = _tolerances(loaded, lens, settings.tolerances)
    exported = export_lens(
        lens,
        folder,
        [name for name in settings.formats if name in LENS_FORMATS],
        tolerances,
        design,
        program_name(),
        settings.tolerance_nm,
        progress,
        drawn,
    )
    _export_network(loaded, folder, settings, exported, progress)
    write_record(folder, lens, exported, _source(loaded))
    return folder, exported


def _export_network(
    run: FinishedRun,
    folder: Path,
    settings: ExportSettings,
    exported: Exported,
    progress: Callable[[str], None] | None,
) -> None:
    wanted = [name for name in NETWORK_FORMATS if name in settings.formats]
    if not wanted:
        return
    if not isinstance(run.module, Camera):
        reason = f"the run ({run.experiment}) has no network"
        exported.refused.update(dict.fromkeys(wanted, reason))
        return
    network = exportable(run.module, settings.size, settings.multiple)
    for name in wanted:
        if progress is not None:
            progress(name)
        write, file, what = {
            "torch": (export_torch, "network.pt2", "the network, as torch.export.load reads it"),
            "onnx": (export_onnx, "network.onnx", "the network as ONNX"),
        }[name]
        try:
            found = write(network, folder / file)
        except InputError as error:
            exported.refused[name] = str(error)
        else:
            exported.files[file] = {"is": what, **found.facts}


def _tolerances(run: FinishedRun, lens: Lens, file: str | None) -> tuple[Lens, ShopTolerances]:
    """Return the lens that the drawings show, and their tolerances."""
    if file is not None:
        return read_tolerances(lens, file)
    given = OmegaConf.select(run.cfg, "tolerances")
    if not given:
        return lens, ShopTolerances()
    factor = OmegaConf.select(run.cfg, "tolerance_factor", default=1.0)
    found = tolerances_from(lens, OmegaConf.to_container(given, resolve=True), factor)
    return lens, ShopTolerances(drawn_labels(found))


def _source(run: FinishedRun) -> dict[str, Any]:
    checkpoint = None if run.checkpoint is None else run.checkpoint.name
    return {
        "run": run.folder.name,
        "experiment": run.experiment,
        "status": run.status,
        "checkpoint": checkpoint,
        "step": run.step,
    }
