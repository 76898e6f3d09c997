"""The truth of a camera whose distortion was calibrated by the centroids of its spots."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dolens.experiments.camera.views.truth import light_imaging, reference_chief_ray_map
from dolens.optics.lens import Lens
from dolens.rendering.plane_points import chief_ray_points, plane_points
from dolens.rendering.psf_grid import sampled_disc
from dolens.scene.planar import as_planes
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# Strata along each side of the pupil whose light a centroid is of.
_SAMPLES = 16


def reference_centroid_map(
    lens: Lens,
    values: Mapping[str, Tensor],
    scene: Scene,
    whole: Sensor,
    windows: Sequence[Sensor],
) -> list[tuple[Tensor, Tensor]]:
    """Return the same map moved by the centroid of the light at the middle of each window.

    Coma puts the centroid of a spot beside its chief ray; images of a target, by which distortion
    is calibrated, show the centroid.  Arguments and returns as of `reference_chief_ray_map`.
    """
    found = reference_chief_ray_map(lens, values, scene, whole, windows)
    moves = centroid_moves(lens, values, scene, whole, _middles(windows))
    return [
        (rows + down[:, None, None], columns + across[:, None, None])
        for (rows, columns), down, across in zip(found, *moves, strict=True)
    ]


def centroid_moves(
    lens: Lens,
    values: Mapping[str, Tensor],
    scene: Scene,
    whole: Sensor,
    points: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Return by how much the centroids of the light at points of the sensor lie beside the chief
    rays, at the reference wavelength.

    Args:
        lens: as of `reference_chief_ray_map`, and the others.
        values: the lens's variables.
        scene: D planes.
        whole: the sensor.
        points: x and y, mm, each (N,), double precision.

    Returns:
        Rows and columns in the image of a pinhole, each (N, D), in double precision.
    """
    system = lens.system(values)
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
