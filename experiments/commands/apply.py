"""A finished run's camera is applied to pictures, or restores raw numbers of a real sensor."""

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.reconstruction import evaluating
from dolens.experiments.camera.restored_windows import DEFAULT_WINDOW, margin_of, restore_in_windows
from dolens.experiments.camera.views.whole import Placing
from dolens.experiments.commands.apply_options import Options
from dolens.experiments.commands.pictures import (
    Applied,
    apply_to_files,
    check_files,
    check_size,
    names_at_depths,
    read_array,
    written,
)
from dolens.experiments.running.finished_run import FinishedRun, load_run
from dolens.experiments.running.trust import own_folder
from dolens.reconstruction.whole_pictures import restore_whole_picture
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.display import linear_picture, write_picture
from dolens.sensor.readout import Readout

logger = logging.getLogger(__name__)


class PictureCamera:
    """A finished run's camera, ready for pictures.

    Args:
        run: the run, of a camera.
        options: see `Options`.

    Attributes:
        margin: pixels that the network looks beyond a window; None: it sees whole pictures, or is
            told the functions of windows' own places.

    Raises:
        InputError: the run is of no camera, or its network cannot restore by place.
    """

    def __init__(self, run: FinishedRun, options: Options) -> None:
        if not isinstance(run.module, Camera):
            raise InputError(
                f"{run.folder}: experiment={run.experiment} has trained no camera that restores "
                "images"
            )
        self.run, self.options = run, options
        self.camera: Camera = run.module
        if self.camera.knows_places and not self.camera.network.needs_noise:
            raise InputError(
                f"network: {type(self.camera.network).__name__} takes no noise, with which "
                "pictures of a field are restored by place"
            )
        if options.raw and self.camera.views.readouts:
            raise InputError("--raw: a camera of several readouts; allowed: pictures")
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.camera.to(device)
        self.device = device
        with torch.no_grad():
            values = {n: v.detach() for n, v in self.camera.variables().items()}
            self.lens = self.camera.lens.with_values(values)
            self.functions = self._functions()
        self.margin: int | None = None
        self._chosen = DEFAULT_WINDOW  # by place for the last picture
        if self.camera.knows_places:
            return
        noise = self.camera.noise()
        network, several = self.camera.network, self.camera.views.readouts
        self.margin = margin_of(network, self.functions, device, noise=noise, readouts=several)
        if self.margin is None:
            logger.warning(
                "The network looks farther than 200 pixels around each, or one cannot tell: "
                "pictures are restored as a whole"
            )

    def _functions(self) -> Tensor | None:
        """The functions that are told of all pictures, where the network asks for any."""
        network, views = self.camera.network, self.camera.views
        if not network.needs_point_spread_function or self.camera.knows_places:
            return None
        return views.point_spread_functions(self.lens)

    @property
    def window(self) -> int:
        """Pixels along each side of what is restored at once."""
        return self.options.window or self._chosen

    @property
    def where(self) -> str:
        """What pictures are restored in, in words."""
        if self.camera.knows_places:
            return f"windows of {self.window} pixels, each by the function of its place"
        if self.margin is None:
            return "whole pictures"
        return f"windows of {self.window} pixels and {self.margin} around them"

    def depths(self) -> list[float]:
        """The depths that pictures are put at, mm."""
        return list(self.options.depths) or [self.camera.views.scene.middle_depth]

    def apply(self, file: Path, folder: Path) -> list[Applied]:
        """Image a picture at each depth, restore it, and write what is found into a folder.

        Raises:
            InputError: the file cannot be read, or is too small; or the depth lies in the lens.
        """
        linear = linear_picture(file, self.options.megapixels)
        check_size(file, linear.shape[-2:])
        names = names_at_depths(file.stem, self.depths())
        return [self._at_depth(linear, depth, name, folder) for depth, name in names.items()]

    def _at_depth(self, linear: Tensor, depth: float, name: str, folder: Path) -> Applied:
        views, options = self.camera.views, self.options
        placing = Placing(depth, options.scale, options.diffraction, options.seed)
        taken = views.whole_picture(self.lens, linear, placing)
        generator = torch.Generator(taken.image.device).manual_seed(options.seed)
        with torch.no_grad():
            signal = views.sensed(taken.image, generator)
        light = views.developed(signal)
        images = {
            "truth": taken.truth[0],
            "sensor": linear_to_srgb(light if views.readouts is None else light.mean(dim=1))[0],
            "restored": self._restored(signal, taken.field, placing),
        }
        files, metrics, shown = written(images, signal[0], depth, name, folder, options)
        return Applied(name, files, metrics, taken.mapping, shown)

    def restore(self, file: Path, folder: Path) -> list[Applied]:
        """Restore what a real sensor of this camera gave, and write the picture into a folder.

        Raises:
            InputError: the file cannot be read, or has other channels than the run's sensor.
        """
        array = read_array(file, self.options.megapixels)
        check_size(file, array.shape[:2])
        readout = self.camera.views.readout
        signal = signal_of(array, readout, file, self.options.black_level, self.options.white_level)
        signal = signal.to(self.device)
        height, width = signal.shape[-2:]
        field = self.camera.views.field_of(height, width)
        restored = self._restored(signal, None if field is None else field[None].to(signal))
        path = folder / f"{file.stem}_restored.{self.options.format}"
        write_picture(path, restored, self.options.bits)
        mapping = f"{width}×{height} raw pixels, taken from the middle of the sensor"
        return [Applied(file.stem, (path,), {}, mapping)]

    def _restored(
        self, signal: Tensor, field: Tensor | None, placing: Placing | None = None
    ) -> Tensor:
        """The picture (3, H, W) of a signal (1, C, H, W), or (1, N, C, H, W) of readouts,
        display-encoded.
        """
        camera, readout = self.camera, self.camera.views.readout
        if camera.knows_places:
            size = (signal.shape[-2], signal.shape[-1])
            known = camera.views.by_place(self.lens, size, placing)
            assert known is not None  # as the camera knows places
            self._chosen = known.window
            told = (known.functions, known.illumination, self.window)
            with evaluating(camera.network):
                found = restore_whole_picture(camera.network, signal[0], readout, *told)
            return found.clamp(0.0, 1.0)
        raw = camera.views.developed(signal)
        settings = (self.window, self.margin, camera.noise())
        found = restore_in_windows(camera.network, raw, self.functions, field, *settings)
        return found[0].clamp(0.0, 1.0)

    def record(self) -> dict[str, Any]:
        """Return what is true of all pictures, for their records."""
        run, options = self.run, self.options
        return {
            "run": str(run.folder),
            "experiment": run.experiment,
            "checkpoint": str(run.checkpoint),
            "step": run.step,
            "seed": options.seed,
            "raw": options.raw,
            "window": self.window,
            "margin": self.margin,
        }


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
    check_files(files)
    into = own_folder(folder, "applied") if out is None else Path(out).expanduser().resolve()
    run = load_run(folder, checkpoint, with_loss=False, trust=trust)
    camera = PictureCamera(run, options)
    each = camera.restore if options.raw else camera.apply
    found = apply_to_files(files, into, each, camera.record, len(camera.depths()))
    return into, camera, found


def signal_of(
    array: np.ndarray,
    readout: Readout,
    file: Path,
    black_level: float | None = None,
    white_level: float | None = None,
) -> Tensor:
    """Return raw numbers as a readout gives them: 0 without light and 1 at full scale.

        signal = (number - black) / (white - black)

    Args:
        array: (height, width), or (height, width, 3).
        readout: of the run: its colour filters, bits and black level.
        file: named in messages.
        black_level: the number of no light; None: that of the readout's codes, and 0 for numbers
            with a fraction.
        white_level: the number at full scale; None: the last of the readout's codes, without bits
            that of the file, and 1 for numbers with a fraction.

    Returns:
        (1, 1 or 3, height, width), float32.

    Raises:
        InputError: other channels than the sensor has, or levels that are not in order.
    """
    if readout.pattern is not None and array.ndim != 2:
        raise InputError(
            f"{file}: {array.shape[-1]} channels; the run's sensor has {readout.pattern} filters: "
            "give one number a pixel, as the sensor has it"
        )
    if readout.pattern is None and (array.ndim != 3 or array.shape[-1] != 3):
        raise InputError(
            f"{file}: of shape {array.shape}; the run's sensor sees all colours in each pixel: "
            "give (height, width, 3)"
        )
    fraction = array.dtype.kind == "f"
    top = 1.0 if fraction else float(np.iinfo(array.dtype).max)
    codes = top if fraction or readout.bits is None else 2.0**readout.bits - 1.0
    no_light = 0.0 if fraction or readout.bits is None else readout.black_level * codes
    black = no_light if black_level is None else black_level
    white = codes if white_level is None else white_level
    if not (math.isfinite(black) and math.isfinite(white) and black < white):
        raise InputError(
            f"--black-level {black:g} and --white-level {white:g}: black must be below white"
        )
    numbers = torch.from_numpy(array.astype(np.float32))
    numbers = numbers[None] if numbers.ndim == 2 else numbers.permute(2, 0, 1)
    signal = ((numbers - black) / (white - black))[None]
    if float(signal.max()) > 1.001:
        logger.warning(
            "%s: numbers up to %g lie above white, %g; is --white-level right?",
            file,
            float(numbers.max()),
            white,
        )
    return signal
