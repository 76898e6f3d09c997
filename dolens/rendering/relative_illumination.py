"""Relative illumination: how bright a white scene is over the sensor."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import pupil_rays, rim_rays
from dolens.scene.scene import bilinear
from dolens.sensor.pixels import Sensor

# Points along the radius of a symmetric lens, or along each side of the sensor.
RADII, _SIDE = 65, 13
# Every so many of them has rays along the edges of apertures, for the derivative.
_RIM_RADII, _RIM_SIDE = 4, 3
# Through the pupil, for each of them and each wavelength.
RAYS = 2048
# Points along the longer side of a map of light.
_MAP_POINTS = 129


def relative_illumination(imaging: ImagingSystem, rays: int = RAYS) -> Tensor:
    """Irradiance of every pixel under a uniform scene, over that on the axis.

    The mean of cos⁴ over the exit pupil as each pixel sees it, vignetting included.  It is found at
    some points and interpolated: bicubically, or linearly along the radius of a lens of rotational
    symmetry (where an edge begins to cut, light is lost in proportion to the radius).

    Args:
        imaging: the lens, C wavelengths, the pixels, and the pupil's disc that is sampled.
        rays: through the pupil, for each point and wavelength; a multiple of four.

    Returns:
        (C, height, width); differentiable in the lens.
    """
    system, sensor = imaging.system, imaging.sensor
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    height, width = sensor.height, sensor.width
    grid = torch.meshgrid(
        torch.arange(height, **options), torch.arange(width, **options), indexing="ij"
    )
    # No two of them on one circle: strata lie on rings, which an aperture's edge takes as wholes.
    spiral = uniform_pupil_points(rays)[0][:rays].to(dtype=system.dtype, device=system.device)
    u, v = spiral.expand(max(RADII, _SIDE**2), -1, -1).unbind(-1)
    disc = u, v
    if system.rotationally_symmetric:
        x, y = sensor.positions(*grid)
        distance = torch.hypot(x, y)
        low, high = float(distance.min()), float(distance.max())
        radius = torch.linspace(low, high, RADII, **options)
        points = (radius, torch.zeros_like(radius))
        _, weight = pupil_rays(imaging, points, disc)
        light = weight.sum(-1)
        few = points[0][::_RIM_RADII], points[1][::_RIM_RADII]
        rim = rim_rays(imaging, few)
        if rim is not None:
            light = light + functional.interpolate(
                rim.weight.sum(-1)[None], size=RADII, mode="linear", align_corners=True
            ).squeeze(0)
        place = (distance - low) * ((RADII - 1) / max(high - low, 1e-300))
        first = place.long().clamp(max=RADII - 2)
        between = (place - first).to(light)
        return torch.lerp(light[:, first], light[:, first + 1], between)
    rows = torch.linspace(0.0, height - 1.0, _SIDE, **options)
    columns = torch.linspace(0.0, width - 1.0, _SIDE, **options)
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    points = sensor.positions(row.reshape(-1), column.reshape(-1))
    _, weight = pupil_rays(imaging, points, disc)
    light = weight.sum(-1).unflatten(-1, (_SIDE, _SIDE))
    x, y = (p.unflatten(0, (_SIDE, _SIDE))[::_RIM_SIDE, ::_RIM_SIDE].reshape(-1) for p in points)
    few = x, y
    rim = rim_rays(imaging, few)
    if rim is not None:
        coarse = rim.weight.sum(-1).unflatten(-1, (-1, 1 + (_SIDE - 1) // _RIM_SIDE))
        light = light + functional.interpolate(
            coarse[None], size=(_SIDE, _SIDE), mode="bilinear", align_corners=True
        ).squeeze(0)
    return functional.interpolate(
        light[None], size=(height, width), mode="bicubic", align_corners=True
    )[0]


def transmission_map(imaging: ImagingSystem, rays: int = 256) -> Tensor | None:
    """Return the share of light that a lens with coatings passes to every pixel, (C, height,
    width), the mean over the pupil; None of a lens without coatings.

    Differentiable in the lens and its coatings.  Arguments are those of `relative_illumination`.
    """
    if not imaging.system.coated:
        return None
    ideal = relative_illumination(replace(imaging, system=imaging.system.uncoated()), rays)
    found = relative_illumination(imaging, rays)
    dark = ideal <= 0.0
    return torch.where(dark, 1.0, found / torch.where(dark, 1.0, ideal))


class IlluminationMap(NamedTuple):
    """An `IlluminationMap` has the relative illumination of a whole sensor, however large it is.

    Attributes:
        light: (C, h, w), at points evenly over the sensor; linear in between.
        share: of a point's distance to the next in a pixel.
        sensor: the pixels.
    """

    light: Tensor
    share: float
    sensor: Sensor

    @classmethod
    @torch.no_grad()
    def of(cls, imaging: ImagingSystem) -> "IlluminationMap":
        """Return the map of an imaging system's sensor; arguments as of `relative_illumination`."""
        sensor = imaging.sensor
        longer = max(sensor.height, sensor.width)
        pitch = sensor.pixel_pitch * max(1.0, (longer - 1) / (_MAP_POINTS - 1))
        share = sensor.pixel_pitch / pitch
        height, width = (
            math.ceil((s - 1) * share - 1e-9) + 1 for s in (sensor.height, sensor.width)
        )
        light = relative_illumination(imaging.on(Sensor(height, width, pitch)))
        return cls(light.float(), share, sensor)

    def __call__(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return relative illumination at rows (N,) and columns (M,), pixels: (C, N, M)."""
        sensor, (height, width) = self.sensor, self.light.shape[-2:]
        down = (rows - 0.5 * (sensor.height - 1)) * self.share + 0.5 * (height - 1)
        across = (columns - 0.5 * (sensor.width - 1)) * self.share + 0.5 * (width - 1)
        grid = torch.meshgrid(down.to(self.light), across.to(self.light), indexing="ij")
        return bilinear(self.light, *grid)
