"""Lights in a picture, and the stray light that they and all of the scene bring to the sensor.

A light is a point that is brighter than white by far: the sun, a lamp.  Its rays are followed to
the sensor along the image's path and along all ghost paths (see `dolens.analysis.ghosts`), and
summed over pixels.  The ghosts of all else in the picture are spread out: a veil as bright as the
mean of the picture times the power of ghosts over that of the image.

A white texel of the area A and the radiance L, seen from a distance d at the angle θ, gives the
irradiance L·A·cos³θ/d² in front of the lens.  On the axis of the sensor white has the irradiance
π·L·sin²θ', θ' being the half angle of the axial beam.  Their quotient turns what ghosts tell,
irradiance over that in front of the lens, into shares of white.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from dolens.analysis.conditions import conditions
from dolens.analysis.ghosts import ENTERING, IMAGE, chosen_paths, ghost_area, ghost_light
from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.ghost_paths import Path
from dolens.optics.lens import Lens
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.starburst import Starburst, bands, starburst
from dolens.scene.scene import bilinear
from dolens.sensor.pixels import Sensor

# Rays of a light that a cell of a ghost's grid has on average: their scatter must not show.
_RAYS_A_CELL = 40.0
_LARGEST_CELL = 64
# Cells of a grid around the sensor, for splines.
_MARGIN = 2
_BOUNCES = (2, 4, 6)
# Fields whose ghosts make the veil, over areas that are alike.
_VEIL_FIELDS = 4


class Light(NamedTuple):
    """A light in a picture.

    Attributes:
        row: pixels from the top of the sensor's upright image.
        column: pixels from the left.
        power: of the light of one white pixel there; of red, green and blue.
        shape: (K, K), K odd, shares of the power of pixels about it; None: a point.  Its ghosts are
            those of a point.
    """

    row: float
    column: float
    power: tuple[float, float, float]
    shape: Tensor | None = None


def light_on_sensor(
    lens: Lens,
    imaging: ImagingSystem,
    plane: int,
    lights: Sequence[Light],
    rays: int = 20_000,
    sensor_reflectance: float = 0.0,
    diffraction: bool = True,
    bounces: int = 2,
) -> Tensor:
    """Return the image and the ghosts of lights, (C, height, width), in shares of white.

    Differentiable in the lens's shapes, gaps and coatings.  A surface without a coating reflects as
    bare glass.

    Args:
        lens: of the imaging system.
        imaging: planes, C wavelengths, pixels and pupil.
        plane: number of the plane that the lights are in, from 0.
        lights: at most as many as patience allows: each takes rays along all paths.
        rays: of each light, path and wavelength.
        sensor_reflectance: share of the light that the sensor reflects.
        diffraction: whether the lights' own images have it where it shows; see
            `dolens.rendering.starburst`.
        bounces: most reflections of a ghost's path, 2, 4 or 6.

    Raises:
        InputError: as `dolens.analysis.ghosts.ghosts` does.
    """
    lens, sensor = in_double_precision(lens), imaging.sensor
    scene, system = imaging.scene, lens.system()
    depth, scale = scene.depths[plane], scene.magnifications(system)[plane]
    paths = _paths(lens, bounces, sensor_reflectance)
    white = math.pi * _axial_aperture(imaging)
    shape = (sensor.height, sensor.width)
    channels = []
    for channel, (wavelength, band) in enumerate(
        zip(scene.wavelengths, bands(scene.wavelengths), strict=True)
    ):
        found = torch.zeros(shape, dtype=torch.float64, device=lens.device)
        grids: dict[int, list[tuple[Tensor, Tensor, Tensor]]] = defaultdict(list)
        for light in lights:
            x, y = object_point(light.row, light.column, sensor, scale)
            cosine = depth / math.hypot(x, y, depth)
            factor = light.power[channel] * cosine**3 / (scale * depth) ** 2 / white
            if factor == 0.0:
                continue
            where = conditions(lens, [(x, y)], [wavelength], depth)
            for part in ghost_light(lens, where, paths, rays, sensor_reflectance):
                if part.path == ENTERING or not len(part.light):
                    continue
                rows, columns = sensor.pixels(*part.points.unbind(-1))
                rays_of = (rows, columns, factor * part.light)
                if part.path != IMAGE:
                    grids[_cell(rows, columns)].append(rays_of)
                    continue
                power = float(rays_of[2].detach().sum())
                star = None
                if diffraction:
                    star = starburst(system, sensor, (x, y, -depth), wavelength, band, power)
                found = found + _own_image(rays_of, star, light.shape, shape)
        channels.append(sum((_on_pixels(*grid, shape) for grid in grids.items()), found))
    return torch.stack(channels)


def _paths(lens: Lens, bounces: int, sensor_reflectance: float) -> list[Path]:
    """Return all ghost paths of two reflections, and of as many more as are asked for."""
    if bounces not in _BOUNCES:
        raise InputError(f"bounces: {bounces}; allowed: 2, 4, 6")
    counts = [count for count in _BOUNCES if count <= bounces]
    return [p for n in counts for p in chosen_paths(lens, n, sensor_reflectance > 0.0, None)]


def _own_image(
    rays: tuple[Tensor, Tensor, Tensor],
    star: Starburst | None,
    source: Tensor | None,
    shape: tuple[int, int],
) -> Tensor:
    """Return the image (height, width) of a light.

    Args:
        rays: rows, columns and light of rays, (N,) each.
        star: its diffraction; None: rays alone.
        source: (K, K), the light's shape; None: a point.
        shape: height and width.
    """
    if star is None:
        image = _on_pixels(1, [rays], shape)
    else:
        image = rays[2].sum() * _with_starburst(*rays, star, shape)
    if source is None:
        return image
    size = [next_fast_len(side + len(source) - 1, real=True) for side in shape]
    spectrum = torch.fft.rfft2(image, s=size) * torch.fft.rfft2(source.to(image), s=size)
    half = len(source) // 2
    whole = torch.fft.irfft2(spectrum, s=size)
    # What transforms round below zero is nothing.
    return whole[half : half + shape[0], half : half + shape[1]].clamp(min=0.0)


def _with_starburst(
    rows: Tensor, columns: Tensor, light: Tensor, star: Starburst, shape: tuple[int, int]
) -> Tensor:
    """Return the image (height, width) of a light of unit power: of its rays and its edge."""
    image = torch.zeros(shape, dtype=torch.float64, device=star.light.device)
    for cell in star.cell.unique().tolist():
        own = star.cell == cell
        part = (star.rows[own], star.columns[own], star.light[own])
        image = image + _on_pixels(cell, [part], shape)
    if star.window is None:
        kept = (1.0 - star.beyond) * light / light.sum()
        return image + _on_pixels(1, [(rows, columns, kept)], shape)
    size = len(star.window)
    (top, left), (height, width) = star.corner, shape
    inside = [
        slice(max(first, 0), min(first + size, side))
        for first, side in ((top, height), (left, width))
    ]
    if any(part.start >= part.stop for part in inside):
        return image
    down, across = inside
    window = star.window[
        down.start - top : down.stop - top, across.start - left : across.stop - left
    ]
    near = torch.zeros_like(image, dtype=torch.bool)
    near[down, across] = True
    edges = (across.start, width - across.stop, down.start, height - down.stop)
    return torch.where(near, torch.nn.functional.pad(window, edges), image)


def _axial_aperture(imaging: ImagingSystem) -> float:
    """Return sin²θ' of the beam to the sensor's centre."""
    pupil = imaging.pupil.numbers()
    length = float(imaging.system.vertices[-1].detach()) - float(pupil.z)
    square = float(pupil.axial_radius) ** 2
    return square / (square + length * length)


def object_point(row: float, column: float, sensor: Sensor, scale: float) -> tuple[float, float]:
    """Return x and y (mm) of the point of the object plane that a pinhole images upright there.

    Args:
        row: pixels.
        column: pixels.
        sensor: the pixels.
        scale: magnification of the plane.
    """
    pitch = sensor.pixel_pitch / scale
    right = column - (0.5 * (sensor.width - 1) - sensor.centre_column)
    down = row - (0.5 * (sensor.height - 1) - sensor.centre_row)
    return right * pitch, -down * pitch


@torch.no_grad()
def _cell(rows: Tensor, columns: Tensor) -> int:
    """Return the side, in pixels, of cells that hold enough of a ghost's rays; a power of two."""
    if len(rows) < 2:
        return _LARGEST_CELL
    (xx, xy), (_, yy) = torch.cov(torch.stack((rows, columns)))
    area = float(ghost_area(xx, xy, yy, 0.0))
    side = math.sqrt(_RAYS_A_CELL * area / len(rows))
    return min(_LARGEST_CELL, 2 ** max(0, math.ceil(math.log2(max(side, 1.0)))))


def _on_pixels(
    cell: int, parts: list[tuple[Tensor, Tensor, Tensor]], shape: tuple[int, int]
) -> Tensor:
    """Sum light (mm² over mm² of a pixel in white) over cells, and interpolate it on pixels."""
    rows, columns, light = (torch.cat(part) for part in zip(*parts, strict=True))
    rows, columns = ((p + 0.5) / cell - 0.5 + _MARGIN for p in (rows, columns))
    size = math.ceil(max(shape) / cell) + 2 * _MARGIN
    inside = (rows > 0.0) & (rows < size - 1.0) & (columns > 0.0) & (columns < size - 1.0)
    near = (p[inside][None] for p in (rows, columns, light))
    grid = rendering.splat(*near, size)[0] / float(cell * cell)
    if cell == 1:
        ends = [_MARGIN + side for side in shape]
        return grid[_MARGIN : ends[0], _MARGIN : ends[1]]
    places = [
        (torch.arange(side, dtype=grid.dtype, device=grid.device) + 0.5) / cell - 0.5 + _MARGIN
        for side in shape
    ]
    return bilinear(grid[None], *torch.meshgrid(*places, indexing="ij"))[0]


def veil(
    lens: Lens,
    imaging: ImagingSystem,
    plane: int,
    sensor_reflectance: float = 0.0,
    bounces: int = 2,
    rays: int = 1000,
) -> Tensor:
    """Return the power of ghosts on the sensor over that of the image, (C,): the mean over the
    picture's area.  Differentiable as `light_on_sensor`, but for what crosses the sensor's edge.

    Args:
        lens: of the imaging system.
        imaging: planes, wavelengths and pixels.
        plane: number of the plane, from 0.
        sensor_reflectance: share of the light that the sensor reflects.
        bounces: most reflections of a ghost's path, 2, 4 or 6.
        rays: of each field, path and wavelength.
    """
    lens, sensor, scene = in_double_precision(lens), imaging.sensor, imaging.scene
    depth, scale = scene.depths[plane], scene.magnifications(lens.system())[plane]
    corner = 0.5 * math.hypot(sensor.width, sensor.height) * sensor.pixel_pitch
    paths = _paths(lens, bounces, sensor_reflectance)
    found = []
    for wavelength in scene.wavelengths:
        ghosts = image = torch.zeros((), dtype=torch.float64, device=lens.device)
        for number in range(_VEIL_FIELDS):
            height = corner * math.sqrt((number + 0.5) / _VEIL_FIELDS) / scale
            where = conditions(lens, [(0.0, height)], [wavelength], depth)
            for part in ghost_light(lens, where, paths, rays, sensor_reflectance):
                if part.path == ENTERING:
                    continue
                caught = (part.light * _caught(part.points.detach(), sensor)).sum()
                if part.path == IMAGE:
                    image = image + caught
                else:
                    ghosts = ghosts + caught
        found.append(ghosts / image.clamp(min=torch.finfo(image.dtype).tiny))
    return torch.stack(found)


def _caught(points: Tensor, sensor: Sensor) -> Tensor:
    """Return which points (N, 2), mm, lie on the sensor."""
    rows, columns = sensor.pixels(*points.unbind(-1))
    inside = (rows > -0.5) & (rows < sensor.height - 0.5)
    return inside & (columns > -0.5) & (columns < sensor.width - 0.5)


Place = TypeVar("Place", float, Tensor)


def on_pixels_of(
    place: tuple[Place, Place], picture: tuple[int, int], sensor: Sensor, cover: float
) -> tuple[tuple[Place, Place], float]:
    """Return rows and columns of a picture in pixels of a sensor as a pinhole sees them, and how
    many of these a pixel of the picture is.

    Args:
        place: pixels of the picture.
        picture: its height and width, pixels; it fills the sensor.
        sensor: the pixels.
        cover: how many times as large as the pinhole's the picture is (see `WholeField.cover`).
    """
    (height, width), (row, column) = picture, place
    down, across = cover * sensor.height / height, cover * sensor.width / width
    rows = (row - 0.5 * (height - 1)) * down + 0.5 * (sensor.height - 1)
    columns = (column - 0.5 * (width - 1)) * across + 0.5 * (sensor.width - 1)
    return (rows, columns), down * across


def lights_of(
    given: Sequence[Sequence[float]],
    picture: tuple[int, int],
    sensor: Sensor,
    cover: float = 1.0,
) -> list[Light]:
    """Return lights as a user names them.

    Args:
        given: row and column, in pixels of the picture, and the power over that of a white pixel of
            it: one number or three.
        picture: its height and width, pixels; it fills the sensor.
        sensor: the pixels.
        cover: as of `on_pixels_of`.

    Raises:
        InputError: a light that has other numbers, none of them finite, or lies beside the picture.
    """
    height, width = picture
    found = []
    for number, one in enumerate(given, 1):
        try:
            row, column, *power = (float(value) for value in one)
        except (TypeError, ValueError):
            row, power = math.nan, []
        if len(power) not in (1, 3) or not all(0.0 <= p < math.inf for p in power):
            raise InputError(
                f"lights: number {number} is {one}; allowed: row, column, and the power over that "
                "of a white pixel, one number or three, 0 or more"
            )
        if not (-0.5 <= row <= height - 0.5 and -0.5 <= column <= width - 0.5):
            raise InputError(
                f"lights: number {number} is at row {row:g}, column {column:g}; allowed: within "
                f"the picture of {height} × {width} pixels"
            )
        red, green, blue = (power * 3)[:3] if len(power) == 1 else power
        (row, column), area = on_pixels_of((row, column), picture, sensor, cover)
        found.append(Light(row, column, (red * area, green * area, blue * area)))
    return found
