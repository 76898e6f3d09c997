"""A small photograph through a lens, made anew in tens of milliseconds when the lens changes."""

import io
import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from matplotlib.cbook import get_sample_data
from PIL import Image
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.exit_pupil import paraxial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.lens_camera import colours_of, distance_of, sensor_behind
from dolens.rendering.plane_points import chief_ray_points
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.planar import PlanarScene, as_planes
from dolens.scene.scene import resized
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.display import linear_picture
from dolens.sensor.pixels import Sensor

# Pixels of a photograph; the smallest part of the sensor that it shows, and how many pixels spots
# are wide there at first, from their middle.
HEIGHT, WIDTH, _PART, _SPOT = 128, 192, 1.0 / 16.0, 6.0
# Parts beside the whole: from the axis to where they touch the sensor's corner.
PARTS = {"centre": 0.0, "edge": 0.9}
# Grids of point spread functions, their sides in pixels, and strata along a side of the pupil.
_FIELDS_OF_WHOLE, _FIELDS, _SMALLEST, _LARGEST, _STRATA = (3, 4), (2, 2), 5, 81, 12
# Times the sensor that a picture may cover, and some room for lenses as they change.
_MOST, _ROOM = 2.0, 1.04
# Of the largest function, how far rays may land from its middle.
_TOO_WIDE = 0.75
_QUALITY = 90


@dataclass(frozen=True)
class DraftCamera:
    """A sensor that stays as it is, behind a lens that changes, before a picture.

    A photograph shows the whole sensor, or a part at its centre or near its edge whose pixels are
    smaller.  It has blur by rays, distortion, lateral colour and relative illumination.  Left out
    are diffraction, noise, and light from outside of the paraxial pupil; its scale follows the
    focal length, and blur wider than 81 pixels is cut.

    Attributes:
        parts: name of a part of the sensor → its pixels.
        textures: linear light (3, h, w) of the picture that each sees.
    """

    parts: dict[str, Sensor]
    textures: dict[str, Tensor]

    @classmethod
    @torch.no_grad()
    def of(cls, lens: Lens, blur: float, light: Tensor) -> "DraftCamera":
        """Return the camera that a lens file means.

        Args:
            lens: as it is at first.
            blur: how far from their centroid rays land at first, mm.
            light: of the picture, linear, (3, h, w), of the photograph's shape.

        Raises:
            InputError: the lens has no image circle, or renderers refuse it.
        """
        whole = sensor_behind(lens, (HEIGHT, WIDTH))
        part = min(max(_PART, blur / (_SPOT * whole.pixel_pitch)), 0.5)
        half, parts = 0.5 / part, {"whole": whole}
        for name, share in PARTS.items():
            away = -share * (half - 0.5) * HEIGHT, share * (half - 0.5) * WIDTH
            parts[name] = Sensor(HEIGHT, WIDTH, part * whole.pixel_pitch, *away)
        textures = dict.fromkeys(parts, resized(light, HEIGHT, WIDTH))
        corner = torch.zeros(1, dtype=torch.float64)
        try:
            down, across = _seen(lens, _scene(lens, whole), whole, whole.positions(corner, corner))
        except InputError:  # its chief ray does not pass
            down = across = 0.0
        cover = _ROOM * max(2.0 * abs(down) / HEIGHT, 2.0 * abs(across) / WIDTH, 1.0)
        cover = min(cover, _MOST)
        textures["whole"] = resized(light, round(cover * HEIGHT), round(cover * WIDTH))
        return cls(parts, textures)

    @torch.no_grad()
    def photograph(self, lens: Lens, part: str, blur: float) -> bytes:
        """Return what a part of the sensor sees through a lens, as a JPEG file.

        Args:
            lens: as it is now.
            part: `whole`, `centre` or `edge`.
            blur: how far from their centroid rays land, mm.

        Raises:
            InputError: renderers refuse the lens, or blur is far wider than that.
        """
        sensor, texture = self.parts[part], self.textures[part]
        scene, shown = _scene(lens, sensor), texture[None].to(lens.dtype)
        if blur > _TOO_WIDE * _LARGEST * sensor.pixel_pitch:
            raise InputError(f"rays land up to {blur:.3g} mm from their centroid, too far for it")
        size = 2 * min(int(blur / sensor.pixel_pitch), _LARGEST // 2 - 1) + 3
        renderer = PsfRenderer(
            sensor,
            fields=_FIELDS_OF_WHOLE if part == "whole" else _FIELDS,
            size=max(size, _SMALLEST),
            pupil_samples=_STRATA,
            illumination="functions",
            pupil=paraxial_exit_pupil(lens.system(), scene.wavelengths).numbers(),
        )
        try:
            if part != "whole":
                middle = torch.tensor([[HEIGHT - 1], [WIDTH - 1]], dtype=torch.float64) / 2.0
                centre = _seen(lens, scene, sensor, sensor.positions(*middle))
                scene = replace(scene, texture_centre=centre)
            image = renderer.render(lens, scene, shown, 0)
        except InputError:  # chief rays do not pass
            scene = replace(scene, texture_centre=(sensor.centre_row, sensor.centre_column))
            renderer = replace(renderer, registration="pinhole")
            image = renderer.render(lens, scene, shown, 0)
        levels = (255.0 * linear_to_srgb(image[0, 0].clamp(0.0, 1.0))).round().byte()
        buffer = io.BytesIO()
        picture = Image.fromarray(levels.permute(1, 2, 0).numpy())
        picture.save(buffer, "JPEG", quality=_QUALITY, subsampling=0)
        return buffer.getvalue()


def picture_to_photograph(path: str | Path | None) -> Tensor:
    """Return the linear light of a picture's middle, (3, h, w), of the photograph's shape.

    Args:
        path: a file; None: a portrait that comes with Matplotlib.

    Raises:
        InputError: the file is no picture.
    """
    light = linear_picture(path or get_sample_data("grace_hopper.jpg", asfileobj=False))
    height, width = light.shape[-2:]
    rows = min(height, round(width * HEIGHT / WIDTH))
    columns = min(width, round(height * WIDTH / HEIGHT))
    # Of a portrait, the face is above the middle.
    top, left = (height - rows) // 4, (width - columns) // 2
    return light[:, top : top + rows, left : left + columns]


def _scene(lens: Lens, sensor: Sensor) -> PlanarScene:
    """Return a plane at the lens's object distance."""
    distance = math.inf if lens.object_distance is None else float(lens.object_distance)
    return PlanarScene((distance_of(lens, distance, sensor),), colours_of(lens))


def _seen(
    lens: Lens, scene: PlanarScene, sensor: Sensor, point: tuple[Tensor, Tensor]
) -> tuple[float, float]:
    """Return row and column from the axis, in a pinhole's image, of what a point of the sensor
    sees in the middle colour.
    """
    system = lens.system()
    scene.check(system)
    middle = as_planes(scene, wavelengths=(scene.middle_wavelength,))
    pupil = paraxial_exit_pupil(system, middle.wavelengths)
    rows, columns = chief_ray_points(ImagingSystem(system, middle, sensor, pupil), point)
    return float(rows), float(columns)
