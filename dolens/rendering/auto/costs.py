"""Rough costs of renders, to rank them by: two cores of a server CPU, with the backward pass."""

import math

from dolens.rendering.patch_convolution import transform_length
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.relative_illumination import RADII, RAYS
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# Nanoseconds: a ray and surface, forward and back; a ray's lookup of a texel, forward and back; a
# point of a transform, over the logarithm of their number; a pixel's lookup between pixels; a ray's
# splat; a ray and surface of the illumination's map; what a render, and each of its nodes, takes
# whatever its size.  From the times of experiment=speed_vs_error.
_SURFACE, _TEXEL, _TRANSFORM, _LOOKUP, _SPLAT = 5.5, 7.0, 0.6, 35.0, 30.0
_MAPPED, _RENDER, _NODE = 12.0, 4e6, 1e6
_TRANSFORMS = 6  # of texture, kernel and image, forward and back


def rays_cost(sensor: Sensor, samples: int, scene: Scene, surfaces: int, images: int = 1) -> float:
    """Nanoseconds of a render by `samples` rays a pixel and colour."""
    rays = sensor.height * sensor.width * samples * len(scene.wavelengths)
    return rays * (surfaces * _SURFACE + len(scene.depths) * images * _TEXEL)


def psf_cost(renderer: PsfRenderer, scene: Scene, surfaces: int, images: int = 1) -> float:
    """Nanoseconds of a render by point spread functions."""
    sensor, depths, channels = renderer.sensor, len(scene.depths), len(scene.wavelengths)
    nodes = renderer.fields[0] * renderer.fields[1]
    sides = [
        transform_length(
            math.ceil(length if count == 1 else min(length, 2 * length / (count - 1)))
            + renderer.size
        )
        for length, count in zip((sensor.height, sensor.width), renderer.fields, strict=True)
    ]
    points = sides[0] * sides[1]
    transforms = nodes * _TRANSFORMS * channels * depths * images
    cost = _RENDER + nodes * _NODE + transforms * points * math.log2(points) * _TRANSFORM
    cost += renderer.rays_per_image(scene) * (surfaces * _SURFACE + depths * _SPLAT)
    pixels = sensor.height * sensor.width * channels
    if renderer.registration == "chief_rays":
        cost += pixels * 4 * depths * images * _LOOKUP
    if renderer.illumination == "map":
        cost += RADII * RAYS * channels * surfaces * _MAPPED + pixels * _LOOKUP
    return cost
