"""Relative illumination: how bright a white scene is over the sensor."""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from dolens.analysis.ray_intercepts import uniform_pupil_points
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import pupil_rays, rim_rays

# Points along the radius of a symmetric lens, or along each side of the sensor.
RADII, _SIDE = 65, 13
# Every so many of them has rays along the edges of apertures, for the derivative.
_RIM_RADII, _RIM_SIDE = 4, 3
# Through the pupil, for each of them and each wavelength.
RAYS = 2048


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
