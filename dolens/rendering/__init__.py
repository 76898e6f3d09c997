"""Renderers: images of a scene through a lens, by rays and by point spread functions.

A lens before a sensor photographs pictures (`Lens.photograph`, `LensCamera`); renderers image
scenes with gradients.
"""

from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.lens_camera import sensor_behind
from dolens.rendering.photograph import LensCamera, Photograph
from dolens.rendering.protocol import Renderer, SensorWindow
from dolens.rendering.psf import axial_point_spread_functions
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.rendering.relative_illumination import relative_illumination
from dolens.rendering.spot_image import SpotImage, SpotImager
from dolens.rendering.whole_field import WholeField

__all__ = [
    "AutoRenderer",
    "ImagingSystem",
    "LensCamera",
    "Photograph",
    "PsfRenderer",
    "RayRenderer",
    "Renderer",
    "SensorWindow",
    "SpotImage",
    "SpotImager",
    "WholeField",
    "axial_point_spread_functions",
    "relative_illumination",
    "sensor_behind",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
