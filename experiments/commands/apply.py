"""A finished run's camera on a user's own pictures: what its sensor sees, and what is restored."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.restored_windows import (
    margin_of,
    restore_in_windows,
)
from dolens.experiments.camera.views.whole import Placing
from dolens.experiments.commands.apply_options import Options
from dolens.experiments.commands.picture_files import (
    read_array,
    read_picture,
    write_picture,
)
from dolens.experiments.commands.raw_signal import signal_of
from dolens.experiments.running.finished_run import FinishedRun, load_run
from dolens.experiments.running.run_files import write_json
from dolens.experiments.running.trust import own_folder
from dolens.plotting import save_figure
from dolens.plotting.applied_picture import applied_figure
from dolens.reconstruction import psnr_db, structural_similarity
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.image_files import format_of

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
    """

    name: str
    files: tuple[Path, ...]
    metrics: Mapping[str, float]
    mapping: str


class PictureCamera:
    """A finished run's camera, ready for pictures.

    Args:
        run: the run, of a camera.
        options: see `Options`.

    Attributes:
        margin: pixels that the network looks beyond a window; None: it sees whole pictures.

    Raises:
        InputError: the run is of no camera.
    """

    def __init__(self, run: FinishedRun, options: Options) -> None:
        if not isinstance(run.module, Camera):
            raise InputError(
                f"{run.folder}: experiment={run.experiment} has trained no camera that restores "
                "images"
            )
        self.run, self.options = run, options
        self.camera: Camera = run.module
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.camera.to(device)
        self.device = device
        with torch.no_grad():
            self.values = {n: v.detach() for n, v in self.camera.variables().items()}
            self.functions = self.camera.functions(self.values)
        self.margin = margin_of(self.camera.network, self.functions, device)
        if self.margin is None:
            logger.warning(
                "The network looks farther than 200 pixels around each, or one cannot tell: "
                "pictures are restored as a whole"
            )

    def depths(self) -> list[float]:
        """The depths that pictures are put at, mm."""
        return list(self.options.depths) or [self.camera.views.scene.middle_depth]

    def apply(self, file: Path, folder: Path) -> list[Applied]:
        """Image a picture at each depth, restore it, and write what is found into a folder.

        Raises:
            InputError: the file cannot be read, or is too small; or the depth lies in the lens.
        """
        picture = read_picture(file, self.options.megapixels)
        for note in picture.notes:
            logger.warning("%s: %s", file, note)
        _check_size(file, picture.linear.shape[-2:])
        names = {depth: picture.name for depth in self.depths()}
        if len(names) > 1:
            names = {depth: f"{picture.name}_{_label(depth)}" for depth in names}
        return [
            self._at_depth(picture.linear, depth, name, folder) for depth, name in names.items()
        ]

    def _at_depth(self, linear: Tensor, depth: float, name: str, folder: Path) -> Applied:
        views, options = self.camera.views, self.options
        placing = Placing(depth, options.scale, options.diffraction, options.seed)
        taken = views.whole_picture(self.camera.lens, self.values, linear, placing)
        generator = torch.Generator(taken.image.device).manual_seed(options.seed)
        with torch.no_grad():
            signal = views.readout(taken.image, generator)
            raw = views.readout.develop(signal)
        restored = self._restored(raw, taken.field)
        sensor = linear_to_srgb(raw)
        metrics = _metrics(taken.truth, sensor, restored)
        metrics |= {"depth_mm": float(depth)}
        files = [
            self._written(folder, f"{name}_sensor", sensor[0]),
            self._written(folder, f"{name}_restored", restored[0]),
        ]
        if options.save_raw:
            path = folder / f"{name}_raw.npy"
            np.save(path, signal[0].permute(1, 2, 0).squeeze(-1).float().cpu().numpy())
            files.append(path)
        figure = applied_figure(
            {"truth": taken.truth[0], "sensor": sensor[0], "restored": restored[0]},
            {"sensor": metrics["raw_psnr_db"], "restored": metrics["psnr_db"]},
            f"{name.removesuffix(f'_{_label(depth)}')} at {depth / 1000.0:g} m",
        )
        save_figure(figure, folder / f"{name}_comparison.png")
        files.append(folder / f"{name}_comparison.png")
        return Applied(name, tuple(files), metrics, taken.mapping)

    def restore(self, file: Path, folder: Path) -> list[Applied]:
        """Restore what a real sensor of this camera gave, and write the picture into a folder.

        Raises:
            InputError: the file cannot be read, or has other channels than the run's sensor.
        """
        array = read_array(file, self.options.megapixels)
        _check_size(file, array.shape[:2])
        readout = self.camera.views.readout
        signal = signal_of(array, readout, file, self.options.black_level, self.options.white_level)
        raw = readout.develop(signal.to(self.device))
        field = self.camera.views.field_of(*raw.shape[-2:])
        restored = self._restored(raw, None if field is None else field[None].to(raw))
        path = self._written(folder, f"{file.stem}_restored", restored[0])
        mapping = f"{raw.shape[-1]}×{raw.shape[-2]} raw pixels, taken from the middle of the sensor"
        return [Applied(file.stem, (path,), {}, mapping)]

    def _restored(self, raw: Tensor, field: Tensor | None) -> Tensor:
        found = restore_in_windows(
            self.camera.network,
            raw,
            self.functions,
            field,
            self.options.window,
            self.margin,
            self.camera.noise(),
        )
        return found.clamp(0.0, 1.0)

    def _written(self, folder: Path, name: str, encoded: Tensor) -> Path:
        path = folder / f"{name}.{self.options.format}"
        write_picture(path, encoded, self.options.bits)
        return path


def apply_run(
    folder: str | Path,
    files: Sequence[str | Path],
    options: Options,
    checkpoint: str | Path = "last",
    out: str | Path | None = None,
    trust: bool = False,
) -> tuple[Path, PictureCamera, list[Applied]]:
    """Apply a finished run's camera to pictures.

    A picture is the scene: a plane at a depth that shows it.  Where the run's views are of depths,
    a pixel of the picture is one of the sensor, and the lens blurs it as on the axis; the run's
    sensor is a small one, and a larger picture stands for many such fields side by side.  Where
    they are of fields, the picture fills the sensor, and each place has the blur of its own.

    Args:
        folder: of the run.
        files: pictures, or with `options.raw` what a real sensor gave.
        options: see `Options`.
        checkpoint: `last`, `best`, or the path of a file.
        out: where files are written; None: `applied` in the run folder.
        trust: whether the run may call, import and write what it names; see `load_run`.

    Returns:
        The folder that was written to, the camera, and what was found, a picture after the other.

    Raises:
        InputError: the run, an option or a file cannot be used.
    """
    stems = [Path(file).stem for file in files]
    for file in files:
        format_of(Path(file).expanduser())
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{twice}: two pictures of this name would write the same files")
    into = own_folder(folder, "applied") if out is None else Path(out).expanduser().resolve()
    run = load_run(folder, checkpoint, with_loss=False, trust=trust)
    camera = PictureCamera(run, options)
    try:
        into.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--out: {into}: no folder can be made here ({reason})") from None
    found = []
    for file in files:
        each = camera.restore if options.raw else camera.apply
        applied = each(Path(file).expanduser(), into)
        found += applied
        write_json(into / f"{Path(file).stem}.json", _record(camera, file, applied))
    return into, camera, found


def _metrics(truth: Tensor, sensor: Tensor, restored: Tensor) -> dict[str, float]:
    truth = truth.to(restored)
    found = {}
    for prefix, image in (("raw_", sensor.to(restored)), ("", restored)):
        found[f"{prefix}psnr_db"] = float(psnr_db(image, truth))
        found[f"{prefix}ssim"] = float(structural_similarity(image, truth))
    return found


def _record(camera: PictureCamera, file: str | Path, applied: Sequence[Applied]) -> dict[str, Any]:
    run, options = camera.run, camera.options
    return {
        "picture": str(file),
        "run": str(run.folder),
        "experiment": run.experiment,
        "checkpoint": str(run.checkpoint),
        "step": run.step,
        "seed": options.seed,
        "raw": options.raw,
        "window": options.window,
        "margin": camera.margin,
        "images": {
            entry.name: {
                "mapping": entry.mapping,
                "files": [path.name for path in entry.files],
                **entry.metrics,
            }
            for entry in applied
        },
    }


def _check_size(file: Path, size: Sequence[int]) -> None:
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


def _label(depth: float) -> str:
    return f"{depth / 1000.0:g}m"
