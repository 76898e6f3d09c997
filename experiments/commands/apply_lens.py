"""A lens's image of a user's own pictures, and what is restored of it; no run, and no training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from dolens.experiments.commands.apply_options import LensOptions
from dolens.experiments.commands.pictures import (
    Applied,
    apply_to_files,
    check_files,
    check_size,
    names_at_depths,
    written,
)
from dolens.optics.lens import Lens
from dolens.prescriptions import load_lens
from dolens.reconstruction import GeneralRestoration, restore
from dolens.reconstruction.likelihood import depth_picture, depth_probabilities
from dolens.reconstruction.whole_pictures import Restorer
from dolens.rendering import LensCamera, Photograph, sensor_behind
from dolens.rendering.photograph import readout_in
from dolens.sensor.display import linear_picture
from dolens.sensor.pixels import Sensor


class AppliedLens:
    """A lens before a sensor, and what becomes of pictures.

    Args:
        lens: the lens.
        options: see `LensOptions`.
    """

    def __init__(self, lens: Lens, options: LensOptions) -> None:
        self.lens, self.options = lens, options
        self.restorer: Restorer = GeneralRestoration(by_depth=True).eval()
        pattern = "RGGB" if options.bayer else None
        self.readout = readout_in(options.light, options.read_noise, pattern)
        # What was planned for the last picture serves another of its size.
        self._camera: LensCamera | None = None

    def sensor(self, height: int, width: int) -> Sensor:
        """The pixels of a picture; see `sensor_behind`."""
        options = self.options
        pitch = None if options.pitch is None else options.pitch / 1000.0
        settings = (options.sensor, pitch, options.scale or 1.0, options.megapixels)
        return sensor_behind(self.lens, (height, width), *settings)

    def apply(self, file: Path, folder: Path) -> list[Applied]:
        """Image a picture at each depth, restore it, and write what is found into a folder.

        Raises:
            InputError: the file cannot be read, or is too small; or the lens cannot image it.
        """
        linear = linear_picture(file, self.options.megapixels)
        sensor = self.sensor(*linear.shape[-2:])
        check_size(file, (sensor.height, sensor.width))
        camera = self._camera
        if camera is None or camera.field.sensor != sensor:
            settings = (self.options.depths, self.options.diffraction)
            camera = self._camera = LensCamera.of(self.lens, sensor, self.readout, *settings)
        window = self.options.window or camera.field.window()
        names = names_at_depths(file.stem, camera.distances)
        return [
            self._restored(photograph, names[photograph.distance], folder, window)
            for photograph in camera.photographs(linear, self.options.seed)
        ]

    def _restored(self, photograph: Photograph, name: str, folder: Path, window: int) -> Applied:
        camera = photograph.camera
        images = {
            "truth": photograph.truth,
            "sensor": photograph.image,
            "restored": restore(photograph, self.restorer, window).image,
        }
        depths = camera.field.imaging.scene.depths
        if len(set(depths)) > 1:

            def look(raw: Tensor, functions: Tensor, _: None, noise: Tensor) -> Tensor:
                return depth_picture(depth_probabilities(raw, functions, noise), depths)

            images["depth"] = restore(photograph, look, window).image
        files, metrics, shown = written(
            images, photograph.signal, photograph.distance, name, folder, self.options
        )
        mapping = f"{camera.description}; restored in windows of {window} pixels"
        return Applied(name, files, metrics, mapping, shown)

    def record(self) -> dict[str, Any]:
        """Return what is true of all pictures, for their records."""
        options = self.options
        return {
            "lens": self.lens.name,
            "restorer": type(self.restorer).__name__,
            "light": options.light,
            "read_noise": options.read_noise,
            "seed": options.seed,
        }


def apply_lens(
    lens: str | Path,
    files: Sequence[str | Path],
    options: LensOptions,
    out: str | Path | None = None,
) -> tuple[Path, list[Applied]]:
    """Image pictures by a lens and restore them; nothing is trained.

    A picture is the scene: a plane at a depth that fills the sensor.  Each place has the blur of
    its own, with distortion, lateral colour, relative illumination and diffraction.  Of several
    depths the restorer knows the functions of all, and not which of them it is.

    Args:
        lens: a lens file, or the name of a lens that comes with dolens.
        files: pictures.
        options: see `LensOptions`.
        out: where files are written; None: `<lens>_applied` in the working folder.

    Returns:
        The folder that was written to, and what was found, a picture after the other.

    Raises:
        InputError: the lens, an option or a file cannot be used.
    """
    check_files(files)
    camera = AppliedLens(load_lens(lens), options)
    into = Path(f"{Path(lens).stem}_applied" if out is None else out).expanduser().resolve()
    depths = len(options.depths) or 1
    return into, apply_to_files(files, into, camera.apply, camera.record, depths)
