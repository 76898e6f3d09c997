"""Pictures are read as linear light; what a camera makes of them is measured and written."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.commands.apply_options import PictureOptions
from dolens.experiments.running.run_files import write_json
from dolens.photograph_page.page import PAGE, PhotographPage, ShownPhotograph, shown_scores
from dolens.plotting import save_figure
from dolens.plotting.pictures import applied_figure
from dolens.reconstruction.quality import scores_of
from dolens.sensor.display import write_picture
from dolens.sensor.image_files import MEGAPIXELS, format_of, read_numbers


def read_array(path: str | Path, megapixels: float = MEGAPIXELS) -> np.ndarray:
    """Read what a sensor gave, as finite numbers: (height, width), or (height, width, channels).

    See `dolens.sensor.image_files.read_numbers`.

    Raises:
        InputError: the file cannot be read as such numbers.
    """
    path = Path(path).expanduser()
    found = read_numbers(path, megapixels=megapixels)
    if not np.isfinite(found).all():
        raise InputError(f"{path}: some values are not finite")
    return found


logger = logging.getLogger(__name__)

_SMALLEST = 16
# Copies of a picture that are held at once, float32 of three channels; and a warning from there on.
_COPIES, _MUCH_MEMORY = 12, 4e9


@dataclass(frozen=True)
class Applied:
    """What became of one picture at one depth.

    Attributes:
        name: of the picture, with its depth where there are several.
        files: that were written.
        metrics: PSNR and SSIM of the sensor's image (`raw_…`) and of the restored one; empty where
            there is no truth.
        mapping: how the picture came to lie on the sensor, in words.
        shown: as the page of all has it; None where there is no truth.
    """

    name: str
    files: tuple[Path, ...]
    metrics: Mapping[str, float]
    mapping: str
    shown: ShownPhotograph | None = None


def apply_to_files(
    files: Sequence[str | Path],
    into: Path,
    each: Callable[[Path, Path], list[Applied]],
    record: Callable[[], dict[str, Any]],
    depths: int = 1,
) -> list[Applied]:
    """Apply a camera to files, and write beside the images what became of each, and a page of all.

    Args:
        files: of the pictures.
        into: the folder that is written to; it is made.
        each: of a file and that folder: what a camera makes of it.
        record: what is true of all of them, for the record.
        depths: that each picture is put at.

    Raises:
        InputError: the folder cannot be made, or a file not be used.
    """
    try:
        into.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--out: {into}: no folder can be made here ({reason})") from None
    found: list[Applied] = []
    page = PhotographPage(len(files) * depths)
    for file in files:
        applied = each(Path(file).expanduser(), into)
        for entry in applied:
            if entry.shown is not None:
                page.add(entry.shown)
        found += [replace(entry, shown=None) for entry in applied]  # its images are large
        images = {
            entry.name: {
                "mapping": entry.mapping,
                "files": [path.name for path in entry.files],
                # JSON has no infinity, as a depth may be.
                **{n: v if math.isfinite(v) else None for n, v in entry.metrics.items()},
            }
            for entry in applied
        }
        write_json(
            into / f"{Path(file).stem}.json", {"picture": str(file), "images": images, **record()}
        )
    if any(entry.metrics for entry in found):
        told = record()
        camera = told.get("experiment") or told.get("lens") or "camera"
        page.write(
            into / PAGE,
            f"Photographs through {camera}",
            list(dict.fromkeys(e.mapping for e in found)),
        )
    return found


def check_files(files: Sequence[str | Path]) -> None:
    """Refuse files that are missing or no pictures, or that would write the same ones.

    Raises:
        InputError: the line names the file.
    """
    stems = [Path(file).stem for file in files]
    for file in files:
        format_of(Path(file).expanduser())
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{twice}: two pictures of this name would write the same files")


def check_size(file: Path, size: Sequence[int]) -> None:
    """Refuse a picture (height, width) that is too small, and warn of one that is very large."""
    height, width = size
    if min(height, width) < _SMALLEST:
        raise InputError(
            f"{file}: {width}×{height} pixels; allowed: {_SMALLEST} or more along each side"
        )
    memory = 4.0 * 3 * height * width * _COPIES
    if memory > _MUCH_MEMORY:
        logger.warning(
            "%s: %d×%d pixels take about %.0f GB of memory", file, width, height, memory / 1e9
        )


def names_at_depths(name: str, depths: Sequence[float]) -> dict[float, str]:
    """Return what a picture is called at each depth: by its own name where there is one."""
    if len(set(depths)) == 1:
        return dict.fromkeys(depths, name)
    return {depth: f"{name}_{label(depth)}" for depth in depths}


def label(depth: float) -> str:
    """Return a depth (mm) in metres, as names of files have it: `6m`, `infm` of infinity."""
    return f"{depth / 1000.0:g}m"


def written(
    images: Mapping[str, Tensor],
    signal: Tensor,
    depth: float,
    name: str,
    folder: Path,
    options: PictureOptions,
) -> tuple[tuple[Path, ...], dict[str, float], ShownPhotograph]:
    """Measure and write what a camera makes of a picture.

    Args:
        images: truth, sensor and restored, each (3, H, W), display-encoded, and the map of depths
            if there is one.
        signal: what the sensor gave, (1 or 3, H, W), or of N readouts (N, 1 or 3, H, W).
        depth: of the picture, mm.
        name: that files begin with.
        folder: that they are written to.
        options: bits and format.

    Returns:
        The files, PSNR and SSIM, and the photograph for a page.
    """
    truth, files, metrics = images["truth"], [], {"depth_mm": float(depth)}
    for kind, prefix in (("sensor", "raw_"), ("restored", "")):
        image = images[kind]
        metrics |= scores_of(image, truth, prefix)
        files.append(folder / f"{name}_{kind}.{options.format}")
        write_picture(files[-1], image, options.bits)
    if "depth" in images:
        files.append(folder / f"{name}_depth.png")
        write_picture(files[-1], images["depth"], 8)
    if options.save_raw:
        files.append(folder / f"{name}_raw.npy")
        np.save(files[-1], signal.movedim(-3, -1).squeeze(-1).float().cpu().numpy())
    where = f"{depth / 1000.0:g} m" if math.isfinite(depth) else "infinity"
    title = f"{name.removesuffix(f'_{label(depth)}')} at {where}"
    numbers = {"sensor": metrics["raw_psnr_db"], "restored": metrics["psnr_db"]}
    files.append(folder / f"{name}_comparison.png")
    save_figure(applied_figure(images, numbers, title), files[-1])
    return tuple(files), metrics, ShownPhotograph(title, images, shown_scores(metrics))
