"""A lens's image of a user's own pictures, and what is restored of it; no run, and no training."""

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.commands.apply_options import LensOptions
from dolens.experiments.commands.pictures import (
    Applied,
    apply_to_files,
    check_files,
    check_size,
    names_at_depths,
    picture_of,
    written,
)
from dolens.optics.lens import Lens
from dolens.prescriptions import load_lens
from dolens.reconstruction import GeneralRestoration
from dolens.reconstruction.likelihood import depth_picture, depth_probabilities
from dolens.reconstruction.whole_pictures import restore_whole_picture
from dolens.rendering.lens_camera import (
    colours_of,
    distance_of,
    image_circle,
    sensor_for,
    usable_share,
)
from dolens.rendering.whole_field import WholeField
from dolens.scene.planar import PlanarScene
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

logger = logging.getLogger(__name__)

_PATTERN = "RGGB"
# Rows that are read out at once; even, for a pattern of filters.
_BAND = 256


class LensCamera:
    """A lens before a sensor, ready for pictures.

    Args:
        lens: the lens.
        options: see `LensOptions`.
    """

    def __init__(self, lens: Lens, options: LensOptions) -> None:
        self.lens, self.options = lens.requires_grad_(False), options
        self.restorer = GeneralRestoration(by_depth=True).eval()
        self.readout = Readout(
            full_well=options.light,
            read_noise=options.read_noise / options.light,
            pattern=_PATTERN if options.bayer else None,
        )
        # What was planned for the last picture serves another of its size.
        self._field: WholeField | None = None

    def depths(self) -> list[float]:
        """The depths that pictures are put at, mm; by default the lens's own."""
        return list(self.options.depths) or [float(self.lens.object_distance or math.inf)]

    def sensor(self, height: int, width: int) -> Sensor:
        """The pixels of a picture.

        Raises:
            InputError: they are too many or too few, or no image circle is known.
        """
        options = self.options
        pitch = None if options.pitch is None else options.pitch / 1000.0
        settings: Any = ((height, width), options.scale or 1.0, pitch)
        if options.sensor is not None:
            sensor = sensor_for(options.sensor[::-1], *settings)
        else:
            circle = image_circle(self.lens)
            sensor = sensor_for(circle, *settings)
            share = usable_share(self.lens, sensor)
            if 0.0 < share < 1.0:
                logger.warning(
                    "Chief rays pass the lens to %.0f %% of its image circle alone: the sensor is "
                    "smaller by so much",
                    100.0 * share,
                )
                sensor = sensor_for(share * circle, *settings)
        pixels = 1e-6 * sensor.height * sensor.width
        if pixels > options.megapixels:
            raise InputError(
                f"--{'scale' if options.pitch is None else 'pitch'}: the sensor would have "
                f"{pixels:.3g} megapixels; allowed: --megapixels, {options.megapixels:g}"
            )
        return sensor

    def apply(self, file: Path, folder: Path) -> list[Applied]:
        """Image a picture at each depth, restore it, and write what is found into a folder.

        Raises:
            InputError: the file cannot be read, or is too small; or the lens cannot image it.
        """
        picture = picture_of(file, self.options)
        sensor = self.sensor(*picture.linear.shape[-2:])
        check_size(file, (sensor.height, sensor.width))
        field = self._field
        if field is None or field.sensor != sensor:
            depths = tuple(distance_of(self.lens, depth, sensor) for depth in self.depths())
            scene = PlanarScene(depths, colours_of(self.lens))
            field = WholeField.of(self.lens, scene, sensor, self.options.diffraction)
            self._field = field
        texture = field.texture(picture.linear)
        del picture
        window = self.options.window or field.window()
        names = names_at_depths(file.stem, self.depths())
        return [
            self._at_depth(field, texture, number, name, folder, window)
            for number, name in enumerate(names.values())
        ]

    def _at_depth(
        self,
        field: WholeField,
        texture: Tensor,
        number: int,
        name: str,
        folder: Path,
        window: int,
    ) -> Applied:
        options = self.options
        signal = read_out(field.image(texture, number), self.readout, options.seed)
        places = (signal, self.readout, field.functions, field.illumination, window)
        images = {
            "truth": linear_to_srgb(field.truth(texture, number)),
            "sensor": linear_to_srgb(self.readout.develop(signal)),
            "restored": restore_whole_picture(self.restorer, *places).clamp_(0.0, 1.0),
        }
        depths = field.imaging.scene.depths
        if len(set(depths)) > 1:

            def look(raw: Tensor, functions: Tensor, _: None, noise: Tensor) -> Tensor:
                return depth_picture(depth_probabilities(raw, functions, noise), depths)

            images["depth"] = restore_whole_picture(look, *places)
        depth = self.depths()[number]
        files, metrics = written(images, signal, depth, name, folder, options)
        return Applied(name, files, metrics, self._mapping(field, window))

    def _mapping(self, field: WholeField, window: int) -> str:
        sensor, renderer = field.sensor, field.renderer
        waves = ", ".join(f"{w:.4g}" for w in field.imaging.scene.wavelengths)
        filters = f", filters {_PATTERN}" if self.options.bayer else ""
        width, height = (n * sensor.pixel_pitch for n in (sensor.width, sensor.height))
        return (
            f"{sensor.width}×{sensor.height} pixels of {1000.0 * sensor.pixel_pitch:.3g} µm, "
            f"{width:.3g}×{height:.3g} mm{filters}; {waves} nm; {self.options.light:g} electrons "
            f"in white, read noise {self.options.read_noise:g}; point spread functions at "
            f"{renderer.fields[1]}×{renderer.fields[0]} places, diffraction: "
            f"{renderer.diffraction}; restored in windows of {window} pixels"
        )

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


def read_out(image: Tensor, readout: Readout, seed: int) -> Tensor:
    """Read an image (3, H, W) out in bands of rows, for memory: (3 or 1, H, W), as the readout
    gives it.
    """
    generator = torch.Generator(image.device).manual_seed(seed)
    channels = 3 if readout.pattern is None else 1
    signal = image if channels == 3 else image.new_empty(1, *image.shape[1:])
    for first in range(0, image.shape[1], _BAND):
        band = slice(first, first + _BAND)
        signal[:, band] = readout(image[:, band], generator)
    return signal


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
    camera = LensCamera(load_lens(lens), options)
    into = Path(f"{Path(lens).stem}_applied" if out is None else out).expanduser().resolve()
    return into, apply_to_files(files, into, camera.apply, camera.record)
