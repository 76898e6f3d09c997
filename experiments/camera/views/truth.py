"""The truth that images are compared with: those of an ideal camera."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.system import OpticalSystem
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.differentiable_geometry import (
    differentiable_chief_pupil,
    differentiable_exit_pupil,
)
from dolens.rendering.exit_pupil import paraxial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.scene.planar import as_planes
from dolens.scene.scene import Scene, bilinear, texture_origin
from dolens.sensor.pixels import Sensor

TRUTHS = ("pinhole", "chief_rays")
CENTROIDS = "centroids"


def check_truth(name: str, allowed: Sequence[str] = TRUTHS) -> str:
    """The name itself; raises `InputError` naming the allowed ones."""
    if name not in allowed:
        raise InputError(f"views.truth: '{name}' is unknown; allowed: {', '.join(allowed)}")
    return name


def reference_chief_ray_map(
    lens: Lens,
    values: Mapping[str, Tensor],
    scene: Scene,
    whole: Sensor,
    windows: Sequence[Sensor],
) -> list[tuple[Tensor, Tensor]]:
    """Return the chief-ray map of windows' pixels at the reference wavelength, on a scene's planes.

    Differentiable in the values: the truth moves with the lens's distortion and magnification, as
    the image does.

    Returns:
        Of each window rows and columns from the axis in the image of a pinhole, each
        (D, height, width), in double precision.
    """
    object_points = chief_ray_maps(reference_imaging(lens, values, scene, whole), windows)
    return [(rows[:, 0], columns[:, 0]) for rows, columns in object_points]


def reference_imaging(
    lens: Lens, values: Mapping[str, Tensor], scene: Scene, whole: Sensor
) -> ImagingSystem:
    """Return the lens at its reference wavelength, with a pupil that is enough for chief rays."""
    system = lens.system(values)
    wavelengths = (lens.primary_wavelength,)
    planes = as_planes(scene, wavelengths=wavelengths)
    pupil = differentiable_chief_pupil(
        system, wavelengths, paraxial_exit_pupil(system, wavelengths)
    )
    return ImagingSystem(system, planes, whole, pupil)


def light_imaging(system: OpticalSystem, scene: Scene, whole: Sensor) -> ImagingSystem:
    """Return a lens in front of the whole sensor, with the pupil of its light, which follows it."""
    imaging = ImagingSystem.of(system, scene, whole)
    pupil = differentiable_exit_pupil(system, scene.wavelengths, imaging.pupil)
    return ImagingSystem(system, scene, whole, pupil)


def sample_texture(
    textures: Tensor, rows: Tensor, columns: Tensor, centre: tuple[float, float]
) -> Tensor:
    """Textures (..., h, w) at rows and columns (H, W) from the axis: (..., H, W).

    Args:
        textures: linear light.
        rows: below the axis in the image of a pinhole, pixels.
        columns: right of it.
        centre: where the textures' centre lies, as `Scene.texture_centre`.
    """
    height, width = textures.shape[-2:]
    row, column = texture_origin((height, width), centre)
    flat = textures.reshape(-1, height, width)
    found = bilinear(flat, (rows + row).to(textures), (columns + column).to(textures))
    return found.reshape(*textures.shape[:-2], *rows.shape)


def nearest_texel(rows: Tensor, columns: Tensor) -> tuple[float, float]:
    """The middle of rows and columns, to a whole texel; no gradient."""
    with torch.no_grad():
        return float(rows.mean().round()), float(columns.mean().round())
