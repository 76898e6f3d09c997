"""The point spread functions of places of a large sensor, by which its images are restored."""

from collections.abc import Mapping

from torch import Tensor

from dolens.experiments.camera.views.centroids import centroid_moves
from dolens.experiments.camera.views.truth import CENTROIDS, light_imaging, reference_imaging
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import say_once, with_chosen_backend
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_grid import (
    IdealPlaces,
    PlaceFunctions,
    chief_ray_places,
    pinhole_places,
    place_functions,
)
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# A window that loses more of a function's light than this is worth a warning.
_NOTABLE_LOSS = 0.01


def field_imaging(
    lens: Lens, values: Mapping[str, Tensor], scene: Scene, whole: Sensor
) -> ImagingSystem:
    """Return the lens in front of the whole sensor, with a pupil that follows its values."""
    return light_imaging(with_chosen_backend(lens.system(values)), scene, whole)


def ideal_places(
    lens: Lens,
    values: Mapping[str, Tensor],
    scene: Scene,
    whole: Sensor,
    points: tuple[Tensor, Tensor],
    truth: str,
) -> IdealPlaces:
    """Return what the camera of a field's truth sees at points of the sensor, and near them.

    Args:
        lens: as of `reference_chief_ray_map`, and the others.
        values: the lens's variables.
        scene: planes.
        whole: the sensor.
        points: x and y, mm, each (N,), double precision.
        truth: `chief_rays`, `centroids` or `pinhole`, as of `FieldViews`.
    """
    imaging = reference_imaging(lens, values, scene, whole)
    if truth == "pinhole":
        return pinhole_places(imaging, points)
    found = chief_ray_places(imaging, points)
    if truth != CENTROIDS:
        return found
    down, across = centroid_moves(lens, values, scene, whole, points)
    return found._replace(rows=found.rows + down, columns=found.columns + across)


def field_functions(
    lens: Lens,
    values: Mapping[str, Tensor],
    scene: Scene,
    whole: Sensor,
    points: tuple[Tensor, Tensor],
    truth: str,
    size: int,
    diffraction: str,
) -> PlaceFunctions:
    """Return the point spread functions of points of the sensor; see `place_functions`.

    Arguments as of `ideal_places`, and pixels along each side and the model of diffraction.
    """
    found = place_functions(
        field_imaging(lens, values, scene, whole),
        points,
        ideal_places(lens, values, scene, whole, points, truth),
        size,
        diffraction,
    )
    if float(found.truncated) > _NOTABLE_LOSS:
        say_once(
            f"views: {100 * float(found.truncated):.0f} % of a point spread function's light falls "
            f"beyond the {size} pixels that restorers are told; a larger psf_size keeps it"
        )
    return found
