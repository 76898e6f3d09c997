"""The truth of a camera whose distortion was calibrated by the centroids of its spots."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dolens.experiments.camera.views.truth import reference_chief_ray_map
from dolens.optics.lens import Lens
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import chief_ray_points, plane_points
from dolens.rendering.psf_grid import sampled_disc
from dolens.rendering.pupil.differentiable_pupil import differentiable_exit_pupil
from dolens.rendering.pupil.exit_pupil import sampled_exit_pupil
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
    system = lens.system(values)
    wavelengths = (lens.primary_wavelength,)
    planes = as_planes(scene, wavelengths=wavelengths)
    with torch.no_grad():
        pupil = sampled_exit_pupil(system, wavelengths, whole)
    pupil = differentiable_exit_pupil(system, wavelengths, pupil)
    imaging = ImagingSystem(system, planes, whole, pupil)
    points = _middles(windows)
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), _SAMPLES, None, system)
    seen = plane_points(imaging, points, disc)
    weight = seen.weight.expand(seen.rows.shape)
    share = weight / weight.sum(-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    chief = chief_ray_points(imaging, points)
    moves = [
        ((share * places).sum(-1).double() - centre)[:, :, 0, None, None]
        for places, centre in zip((seen.rows, seen.columns), chief, strict=True)
    ]
    found = reference_chief_ray_map(lens, values, scene, whole, windows)
    return [
        (rows + down, columns + across)
        for (rows, columns), down, across in zip(found, *moves, strict=True)
    ]


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
