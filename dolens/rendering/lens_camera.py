"""The camera that a lens file means: its colours, its image circle, pixels for a picture."""

import math

import torch

from dolens.analysis.conditions import VISIBLE
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Status
from dolens.sensor.pixels import Sensor

# A plane so far away that its blur differs from that at infinity by this share of a pixel; and mm,
# between which it is.
_PIXEL_SHARE, _FAR, _FARTHEST = 0.01, 1e6, 1e9


def colours_of(lens: Lens) -> tuple[float, float, float]:
    """Return the wavelengths (nm) of red, green and blue: the longest, the reference or middle one,
    and the shortest of the lens's own.

    A lens of one wavelength in the visible has lines C and F beside it; another has it thrice.
    """
    own = sorted(lens.wavelengths or (lens.primary_wavelength,))
    middle = lens.primary_wavelength
    if len(own) == 1 and VISIBLE[0] <= middle <= VISIBLE[1]:
        own = [VISIBLE[0], middle, VISIBLE[1]]
    if not own[0] < middle < own[-1]:
        middle = own[len(own) // 2]
    return own[-1], middle, own[0]


@torch.no_grad()
def image_circle(lens: Lens) -> float:
    """Return the diameter (mm) of the image: what the prescription says, else that of its fields.

    Raises:
        InputError: it names no sensor and no field off the axis, or no chief ray of one arrives.
    """
    if lens.sensor_diameter:
        return float(lens.sensor_diameter)
    points = [p for p in (lens.fields.points if lens.fields else ()) if math.hypot(*p) > 0.0]
    if not points:
        raise InputError(
            f"lens '{lens.name}' names no sensor's diameter and no field off the axis: give the "
            "sensor's width and height"
        )
    distance = None if vergence(lens.object_distance) == 0.0 else lens.object_distance
    fields = torch.tensor([(0.0, 0.0), *points], dtype=lens.dtype, device=lens.device)
    rays = lens.chief_ray(fields, lens.primary_wavelength, distance)
    hit = lens.trace(rays)
    arrives = (hit.status == Status.OK) | (hit.status == Status.VIGNETTED)
    away = (hit.position - hit.position[0])[..., :2].norm(dim=-1)[arrives & rays.converged]
    if not (len(away) and float(away.max()) > 0.0):
        raise InputError(
            f"lens '{lens.name}': no chief ray of its fields reaches the sensor: give the "
            "sensor's width and height"
        )
    return 2.0 * float(away.max())


def sensor_for(
    picture: tuple[int, int],
    extent: float | tuple[float, float],
    scale: float = 1.0,
    pitch: float | None = None,
) -> Sensor:
    """Return the pixels of a picture that is as large as fits on a sensor.

    Args:
        picture: its height and width, pixels.
        extent: of the sensor, mm: the diameter of a circle, or height and width.
        scale: pixels of the picture to one of the sensor, along each side.
        pitch: of the pixels, mm; None: what the scale makes of it.
    """
    height, width = picture
    if isinstance(extent, float):
        one = extent / math.hypot(height, width)
    else:
        one = min(extent[0] / height, extent[1] / width)
    pitch = scale * one if pitch is None else pitch
    rows, columns = (max(1, round(side * one / pitch)) for side in picture)
    return Sensor(rows, columns, pitch)


def distance_of(lens: Lens, depth: float, sensor: Sensor) -> float:
    """Return a depth (mm) itself, or of infinity one that blurs alike within 1 % of a pixel."""
    if math.isfinite(depth):
        return depth
    first = lens.first_order(lens.primary_wavelength)
    size = abs(float(first.efl.detach()) * float(first.entrance_pupil.diameter))
    return min(max(_FAR, size / (_PIXEL_SHARE * sensor.pixel_pitch)), _FARTHEST)
