"""Images are compared with the truth: those of an ideal or a calibrated camera."""

from collections.abc import Sequence

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
from dolens.rendering.plane_points import chief_ray_points, plane_points
from dolens.rendering.psf_grid import sampled_disc
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
    object_points = chief_ray_maps(reference_imaging(lens, scene, whole), windows)
    return [(rows[:, 0], columns[:, 0]) for rows, columns in object_points]


def reference_imaging(lens: Lens, scene: Scene, whole: Sensor) -> ImagingSystem:
    """Return the lens at its reference wavelength, with a pupil that is enough for chief rays."""
    system = lens.system()
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


# Strata along each side of the pupil whose light a centroid is of.
_SAMPLES = 16


def reference_centroid_map(
    lens: Lens,
    scene: Scene,
    whole: Sensor,
    windows: Sequence[Sensor],
) -> list[tuple[Tensor, Tensor]]:
    """Return the same map moved by the centroid of the light at the middle of each window.

    Coma puts the centroid of a spot beside its chief ray; images of a target, by which distortion
    is calibrated, show the centroid.  Arguments and returns as of `reference_chief_ray_map`.
    """
    found = reference_chief_ray_map(lens, scene, whole, windows)
    moves = centroid_moves(lens, scene, whole, _middles(windows))
    return [
        (rows + down[:, None, None], columns + across[:, None, None])
        for (rows, columns), down, across in zip(found, *moves, strict=True)
    ]


def centroid_moves(
    lens: Lens,
    scene: Scene,
    whole: Sensor,
    points: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Return by how much the centroids of the light at points of the sensor lie beside the chief
    rays, at the reference wavelength.

    Args:
        lens: as of `reference_chief_ray_map`, and the others.
        scene: D planes.
        whole: the sensor.
        points: x and y, mm, each (N,), double precision.

    Returns:
        Rows and columns in the image of a pinhole, each (N, D), in double precision.
    """
    system = lens.system()
    planes = as_planes(scene, wavelengths=(lens.primary_wavelength,))
    imaging = light_imaging(system, planes, whole)
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), _SAMPLES, None, system)
    seen = plane_points(imaging, points, disc)
    weight = seen.weight.expand(seen.rows.shape)
    share = weight / weight.sum(-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    down, across = (
        ((share * places).sum(-1).double() - centre)[:, :, 0]
        for places, centre in zip(
            (seen.rows, seen.columns), chief_ray_points(imaging, points), strict=True
        )
    )
    return down, across


def _middles(windows: Sequence[Sensor]) -> tuple[Tensor, Tensor]:
    """Return x and y of the middles of windows, mm, each (W,)."""
    options = {"dtype": torch.float64}
    places = [
        window.positions(
            torch.tensor(0.5 * (window.height - 1), **options),
            torch.tensor(0.5 * (window.width - 1), **options),
        )
        for window in windows
    ]
    x, y = (torch.stack(axis) for axis in zip(*places, strict=True))
    return x, y
