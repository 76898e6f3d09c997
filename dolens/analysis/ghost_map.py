"""The irradiance of all ghosts of an object point over the sensor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.ghosts import BLOCKS, ENTERING, IMAGE, GhostLight, chosen_paths, ghost_light
from dolens.errors import InputError, check_count
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.ghost_paths import Path
from dolens.optics.lens import Lens

# Of a lens that names no sensor: so many RMS radii of the light about the axis.
_REACH = 1.5


@dataclass(frozen=True)
class GhostMap:
    """Irradiance of the ghosts of an object point on P × P pixels of the sensor.

    Attributes:
        where: its field, wavelengths and object distance.
        paths: that count, each as the surfaces that reflect.
        width: mm, of the square, about the sensor's vertex.
        irradiance: (P, P), rows along y from below, over that of the light in front of the lens.
        error: (P, P), standard error of each pixel.
        image: mm, x and y of the image's centroid; NaN without one.
    """

    where: Conditions
    paths: tuple[Path, ...]
    width: float
    irradiance: Tensor
    error: Tensor
    image: tuple[float, float]

    @property
    def relative_error(self) -> float:
        """Return the RMS of all pixels' errors over that of their irradiance; 0 in the dark."""
        light = float(self.irradiance.norm())
        return float(self.error.norm()) / light if light > 0.0 else 0.0


@torch.no_grad()
def ghost_map(
    lens: Lens,
    where: Conditions,
    rays: int = 50_000,
    pixels: int = 64,
    width: float | None = None,
    bounces: int = 2,
    sensor_reflectance: float = 0.0,
    paths: Sequence[Sequence[int]] | None = None,
) -> GhostMap:
    """Map the ghosts of an object point; other arguments are those of `dolens.analysis.ghosts`.

    A ray's light is shared among the four pixels whose centres are nearest, so that irradiance is
    seen through a triangle of two pixels.  Peaks narrower than that are higher than they look.

    Args:
        lens: the lens.
        where: one field, wavelengths, and object distance.
        rays: of each path and wavelength.
        pixels: along each side.
        width: mm, of the square; None: the sensor's diameter, or all that is lit.
        bounces: reflections of a path.
        sensor_reflectance: share of the light that the sensor reflects.
        paths: those that count; None: all.

    Raises:
        InputError: as `ghosts` does, or a width that is not positive.
    """
    check_count("pixels", pixels, 2)
    if width is not None and not 0.0 < width < math.inf:
        raise InputError(f"width: {width}; allowed: a positive number of mm")
    lens = in_double_precision(lens)
    chosen = chosen_paths(lens, bounces, sensor_reflectance > 0.0, paths)
    parts = [
        part
        for part in ghost_light(lens, where.that_count(), chosen, rays, sensor_reflectance)
        if part.path != ENTERING
    ]
    images = [part for part in parts if part.path == IMAGE]
    ghosts = [part for part in parts if part.path != IMAGE]
    if width is None:
        width = lens.sensor_diameter or 2.0 * _reach([(p.points, p.light) for p in parts])
    pixel = width / pixels
    sums = np.zeros(BLOCKS * pixels * pixels)
    for part in ghosts:
        _add(sums, part, pixel, pixels)
    blocks = torch.from_numpy(sums).reshape(BLOCKS, pixels, pixels) * (BLOCKS / (pixel * pixel))
    total = sum(part.light.sum() for part in images)
    centre = sum((part.light @ part.points) for part in images) / total
    x, y = torch.as_tensor(centre).tolist()
    return GhostMap(
        where,
        tuple(chosen),
        width,
        blocks.mean(0),
        blocks.std(0) / math.sqrt(BLOCKS),
        (x, y),
    )


def _add(sums: np.ndarray, part: GhostLight, pixel: float, pixels: int) -> None:
    """Add light to the pixels (blocks·pixels²,) about the places where it lands."""
    light = part.light.cpu().numpy()
    lit = light > 0.0
    light = light[lit]
    place = part.points.cpu().numpy()[lit] / pixel + 0.5 * (pixels - 1)
    # What lands far off must not overflow an integer.
    place = place.clip(-2.0, pixels + 1.0)
    first = np.floor(place)
    above = place - first
    corner = first.astype(np.int64)
    block = part.block.cpu().numpy()[lit]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = (corner + step).T
        inside = (column >= 0) & (column < pixels) & (row >= 0) & (row < pixels)
        weight = np.where(step, above, 1.0 - above).prod(-1)
        index = (block * pixels + row) * pixels + column
        sums += np.bincount(index[inside], (light * weight)[inside], len(sums))


def _reach(parts: Sequence[tuple[Tensor, Tensor]]) -> float:
    """Return a distance from the axis, mm, that holds nearly all the light of (points, light)."""
    found = 0.0
    for points, light in parts:
        total = float(light.sum())
        if total > 0.0:
            square = float((light[:, None] * points.square()).sum()) / total
            found = max(found, _REACH * math.sqrt(square))
    return found or 1.0
