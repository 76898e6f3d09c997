"""The camera that a lens file means: its colours, its image circle, pixels for a picture."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from numbers import Real

import torch

from dolens.analysis.conditions import VISIBLE
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Status
from dolens.rendering.chief_ray_map import fit_chief_ray_map
from dolens.rendering.exit_pupil import paraxial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.scene.planar import PlanarScene
from dolens.sensor.image_files import MEGAPIXELS
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# A plane so far away that its blur differs from that at infinity by this share of a pixel; and mm,
# between which it is.
_PIXEL_SHARE, _FAR, _FARTHEST = 0.01, 1e6, 1e9
# Shares of a sensor that are tried.
_SHARES = [1.0 - 0.05 * n for n in range(11)]
# Pixels along each side of a sensor, at least; and mm of a pixel and of a sensor, at most.
_FEWEST, _LARGEST_PITCH, _LARGEST_SENSOR = 16, 1e3, 1e5


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
    """Return the diameter (mm) of the image that a prescription means: the smaller of its sensor's
    and that of its fields.

    Raises:
        InputError: it names no sensor and no field off the axis, or no chief ray of one arrives.
    """
    sensor = float(lens.sensor_diameter or math.inf)
    points = [p for p in (lens.fields.points if lens.fields else ()) if math.hypot(*p) > 0.0]
    if not points:
        if math.isfinite(sensor):
            return sensor
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
    if len(away) and float(away.max()) > 0.0:
        return min(sensor, 2.0 * float(away.max()))
    if math.isinf(sensor):
        raise InputError(
            f"lens '{lens.name}': no chief ray of its fields reaches the sensor: give the "
            "sensor's width and height"
        )
    return sensor


def usable_share(lens: Lens, sensor: Sensor) -> float:
    """Return the share of a sensor, along each side, whose chief rays pass the lens.

    They are those of `chief_ray_points`.

    Returns:
        1, or less in steps of 0.05; 0 where half of the sensor is too much.
    """
    scene = PlanarScene((_FAR,), colours_of(lens))
    system = lens.system()
    pupil = paraxial_exit_pupil(system, scene.wavelengths)
    for share in _SHARES:
        part = replace(sensor, pixel_pitch=share * sensor.pixel_pitch)
        try:
            fit_chief_ray_map(ImagingSystem(system, scene, part, pupil))
        except InputError:
            continue
        return share
    return 0.0


def sensor_for(
    extent: float | tuple[float, float],
    picture: tuple[int, int],
    scale: float = 1.0,
    pitch: float | None = None,
) -> Sensor:
    """Return the pixels of a picture that is as large as fits on a sensor.

    Args:
        extent: of the sensor, mm: the diameter of a circle, or height and width.
        picture: its height and width, pixels.
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


@torch.no_grad()
def sensor_behind(
    lens: Lens,
    picture: tuple[int, int],
    size: tuple[float, float] | None = None,
    pixel_pitch: float | None = None,
    scale: float = 1.0,
    megapixels: float = MEGAPIXELS,
) -> Sensor:
    """Return the pixels of a picture behind a lens.

    Args:
        lens: as it is.
        picture: its height and width, pixels.
        size: width and height of the sensor, mm, of which the picture takes as much as its shape
            allows; None: the largest in the image circle whose chief rays pass the lens.
        pixel_pitch: mm; None: what the scale makes of it.
        scale: pixels of the picture to one of the sensor, along each side.
        megapixels: of the sensor, at most, millions of pixels.

    Raises:
        InputError: they are too many or too few, or no image circle is known.
    """
    if pixel_pitch is not None:
        pixel_pitch = required_number("pixel_pitch", pixel_pitch, _LARGEST_PITCH, "mm")
    if size is None:
        circle = image_circle(lens)
        sensor = sensor_for(circle, picture, scale, pixel_pitch)
        share = usable_share(lens, sensor)
        if 0.0 < share < 1.0:
            logger.warning(
                "Chief rays pass the lens to %.0f %% of its image circle alone: the sensor is "
                "smaller by so much",
                100.0 * share,
            )
            sensor = sensor_for(share * circle, picture, scale, pixel_pitch)
    else:
        if not isinstance(size, Sequence) or len(size) != 2:
            raise InputError(f"sensor: {size}; allowed: its width and height in mm, as (36, 24)")
        unit = "mm, its width and height"
        width, height = (required_number("sensor", s, _LARGEST_SENSOR, unit) for s in size)
        sensor = sensor_for((height, width), picture, scale, pixel_pitch)
    pixels = 1e-6 * sensor.height * sensor.width
    if pixels > megapixels:
        raise InputError(
            f"{'scale' if pixel_pitch is None else 'pixel_pitch'}: the sensor would have "
            f"{pixels:.3g} megapixels; allowed: {megapixels:g}"
        )
    if min(sensor.height, sensor.width) < _FEWEST:
        raise InputError(
            f"sensor: {sensor.width}×{sensor.height} pixels; allowed: {_FEWEST} or more along "
            "each side"
        )
    return sensor


def required_number(
    name: str, value: object, most: float, unit: str, from_zero: bool = False
) -> float:
    """Return a number above zero that a user gave.

    Args:
        name: the message begins with it.
        value: what a user gave.
        most: the largest that is allowed.
        unit: for the message.
        from_zero: whether zero is allowed too.

    Raises:
        InputError: it is none, or too large.
    """
    number = math.nan
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
    if not (0.0 < number <= most or (from_zero and number == 0.0)):
        least = "0" if from_zero else "above 0"
        largest = "" if math.isinf(most) else f" to {most:g}"
        said = repr(value) if isinstance(value, str) else value
        raise InputError(f"{name}: {said}; allowed: {least}{largest} {unit}")
    return number


@torch.no_grad()
def distance_of(lens: Lens, depth: float, sensor: Sensor) -> float:
    """Return a depth (mm) itself, or of infinity one that blurs alike within 1 % of a pixel."""
    if math.isfinite(depth):
        return depth
    first = lens.first_order(lens.primary_wavelength)
    size = abs(float(first.efl) * float(first.entrance_pupil.diameter))
    return min(max(_FAR, size / (_PIXEL_SHARE * sensor.pixel_pitch)), _FARTHEST)
