"""Images are compared with the truth, those of an ideal or a calibrated camera; of large sensors on
windows.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.errors import check_choice
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import say_once, with_chosen_backend
from dolens.optics.system import OpticalSystem
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.differentiable_geometry import (
    differentiable_chief_pupil,
    differentiable_exit_pupil,
)
from dolens.rendering.exit_pupil import paraxial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import chief_ray_points, plane_points
from dolens.rendering.psf_grid import (
    IdealPlaces,
    PlaceFunctions,
    chief_ray_places,
    pinhole_places,
    place_functions,
    sampled_disc,
)
from dolens.scene.planar import as_planes
from dolens.scene.scene import Scene, bilinear, texture_origin
from dolens.sensor.pixels import Sensor

TRUTHS = ("pinhole", "chief_rays")
CENTROIDS = "centroids"


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


# The golden angle, by which neighbouring textures' windows lie apart in azimuth.
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
TRAINING = ("circle", "radius", "area")


class FieldWindows:
    """Windows of one size: drawn for training, in zones for tests.

    Args:
        whole: the sensor.
        height: of a window, pixels.
        width: likewise.
        training_windows: how training windows are drawn; see `FieldViews`.

    Raises:
        InputError: an unknown way of drawing.
    """

    def __init__(self, whole: Sensor, height: int, width: int, training_windows: str) -> None:
        check_choice(training_windows, TRAINING, "views.training_windows")
        self.whole = whole
        self.height, self.width = height, width
        self.training_windows = training_windows

    @property
    def half_diagonal(self) -> float:
        """Half of the whole sensor's diagonal, mm."""
        return 0.5 * math.hypot(self.whole.height, self.whole.width) * self.whole.pixel_pitch

    def training(self, generator: torch.Generator) -> Sensor:
        """A window to train on."""
        if self.training_windows == "area":
            return self.anywhere(generator)
        free = self.whole.height - self.height, self.whole.width - self.width
        drawn = torch.rand(1, generator=generator, dtype=torch.float64)
        share = float(drawn) if self.training_windows == "radius" else math.sqrt(float(drawn))
        radius = 0.5 * math.hypot(*free) * share
        # Its distance from the middle is drawn, and then its direction.
        while True:
            drawn = torch.rand(1, generator=generator, dtype=torch.float64)
            angle = 2.0 * math.pi * float(drawn)
            down, across = radius * math.sin(angle), radius * math.cos(angle)
            if abs(down) <= 0.5 * free[0] and abs(across) <= 0.5 * free[1]:
                break
        return self._about(down, across)

    def anywhere(self, generator: torch.Generator) -> Sensor:
        """A window drawn evenly from the sensor."""
        top, left = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        return self._at(top, left)

    def zone(self, share: float, number: int) -> Sensor:
        """The window about a point at a share of the half diagonal, or as far as windows reach.

        Its azimuth goes around with the number.
        """
        height, width = self.whole.height, self.whole.width
        radius = 0.5 * share * math.hypot(height, width)
        angle = number * _GOLDEN_ANGLE
        # Beyond the sides only the diagonals lead on.
        if radius > 0.5 * min(height, width):
            corner = math.atan2(height, width)
            angle = (corner, math.pi - corner, math.pi + corner, -corner)[number % 4]
        return self._about(radius * math.sin(angle), radius * math.cos(angle))

    def coordinates(self, window: Sensor, like: Tensor) -> Tensor:
        """(2, H, W): x and y of a window's pixels over half the whole sensor's diagonal."""
        options = {"dtype": torch.float64, "device": like.device}
        row, column = torch.meshgrid(
            torch.arange(window.height, **options),
            torch.arange(window.width, **options),
            indexing="ij",
        )
        return torch.stack(window.positions(row, column)).to(like) / self.half_diagonal

    def _about(self, down: float, across: float) -> Sensor:
        """The window about a point, pixels from the middle, or the nearest that fits."""
        free = self.whole.height - self.height, self.whole.width - self.width
        places = (
            min(max(0.5 + offset / side, 0.0), 1.0) if side else 0.0
            for offset, side in zip((down, across), free, strict=True)
        )
        return self._at(*places)

    def _at(self, down: float, across: float) -> Sensor:
        """The window at shares of the way down and across that it can go."""
        top = round(down * (self.whole.height - self.height))
        left = round(across * (self.whole.width - self.width))
        return self.whole.window(top, left, self.height, self.width)


# A window that loses more of a function's light than this is worth a warning.
_NOTABLE_LOSS = 0.01


def field_imaging(lens: Lens, scene: Scene, whole: Sensor) -> ImagingSystem:
    """Return the lens in front of the whole sensor, with a pupil that follows its values."""
    return light_imaging(with_chosen_backend(lens.system()), scene, whole)


def ideal_places(
    lens: Lens,
    scene: Scene,
    whole: Sensor,
    points: tuple[Tensor, Tensor],
    truth: str,
) -> IdealPlaces:
    """Return what the camera of a field's truth sees at points of the sensor, and near them.

    Args:
        lens: as of `reference_chief_ray_map`, and the others.
        scene: planes.
        whole: the sensor.
        points: x and y, mm, each (N,), double precision.
        truth: `chief_rays`, `centroids` or `pinhole`, as of `FieldViews`.
    """
    imaging = reference_imaging(lens, scene, whole)
    if truth == "pinhole":
        return pinhole_places(imaging, points)
    found = chief_ray_places(imaging, points)
    if truth != CENTROIDS:
        return found
    down, across = centroid_moves(lens, scene, whole, points)
    return found._replace(rows=found.rows + down, columns=found.columns + across)


def field_functions(
    lens: Lens,
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
        field_imaging(lens, scene, whole),
        points,
        ideal_places(lens, scene, whole, points, truth),
        size,
        diffraction,
    )
    if float(found.truncated) > _NOTABLE_LOSS:
        say_once(
            f"views: {100 * float(found.truncated):.0f} % of a point spread function's light falls "
            f"beyond the {size} pixels that restorers are told; a larger psf_size keeps it"
        )
    return found
