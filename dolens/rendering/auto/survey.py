"""Finely sampled point spread functions all over a sensor: what a plan is made from."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.optics.backend import cpu_kernels_serve
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import (
    PlanePoints,
    chief_ray_points,
    pinhole_points,
    plane_points,
)
from dolens.rendering.psf_grid import (
    sampled_disc,
    splat_plane_points,
    wave_cost,
    wave_point_spread_functions,
)
from dolens.rendering.pupil.exit_pupil import working_f_number
from dolens.sensor.pixels import Sensor

# The plastic number's sequence fills a square evenly (Roberts, 2018).
_FIRST, _SECOND = 0.7548776662466927, 0.5698402909980532

Pixels = tuple[Tensor, Tensor]  # fractional rows and columns, each (N,)


@dataclass(frozen=True)
class Survey:
    """Rays of N points of a sensor, on D planes of a scene at C wavelengths.

    Attributes:
        imaging: the lens, the scene, the sensor and the pupil.
        pixels: fractional rows and columns of the points.
        seen: their rays.
        chief: rows and columns of the chief rays, each (N, D, C); None where some do not pass.
        pinhole: rows and columns as a pinhole sees the points.
    """

    imaging: ImagingSystem
    pixels: Pixels
    seen: PlanePoints
    chief: tuple[Tensor, Tensor] | None
    pinhole: tuple[Tensor, Tensor]

    @property
    def f_number(self) -> float:
        """The F-number that the axial beam works with."""
        return working_f_number(self.imaging.pupil, float(self.imaging.system.vertices[-1]))

    @property
    def points(self) -> tuple[Tensor, Tensor]:
        """x and y of the points on the sensor, mm."""
        return self.imaging.sensor.positions(*self.pixels)

    def centres(self, distortion: bool) -> tuple[Tensor, Tensor]:
        """The points that functions are centred on: the chief rays', or a pinhole's."""
        if not distortion:
            return self.pinhole
        assert self.chief is not None  # no plan is made of those that do not pass
        return self.chief

    def offsets(self, distortion: bool) -> PlanePoints:
        """Rays by their distance from the centres."""
        rows, columns = (c[..., None].to(self.seen.rows) for c in self.centres(distortion))
        return PlanePoints(self.seen.rows - rows, self.seen.columns - columns, self.seen.weight)

    def functions(self, size: int, distortion: bool) -> Tensor:
        """(N, D, C, size, size)."""
        fused = cpu_kernels_serve(self.imaging.system)
        return splat_plane_points(self.offsets(distortion), size, fused).functions

    def waves(self, size: int, distortion: bool) -> Tensor:
        """Functions (N, D, C, size, size) with diffraction, of the same points."""
        # Near enough for a plan; direct integration would take minutes.
        settings = DiffractionSettings(method="fourier")
        found = wave_point_spread_functions(self.imaging, self.points, size, distortion, settings)
        return found.functions

    def wave_cost(self, size: int, distortion: bool) -> tuple[int, str | None]:
        """Samples along a pupil, and why Fourier transforms do not do, as `psf_grid.wave_cost`."""
        return wave_cost(self.imaging, self.points, size, distortion)

    def light(self) -> Tensor:
        """(N, 1, C), relative illumination."""
        return self.seen.weight.sum(-1)


@torch.no_grad()
def survey(imaging: ImagingSystem, pixels: Pixels, pupil_samples: int, seed: int = 0) -> Survey:
    """Trace rays from points of a sensor to the planes of a scene.

    All points share their places in the pupil, so that functions of neighbours are alike in what
    the sampling leaves.

    Args:
        imaging: the lens, the scene, the sensor and the pupil, numbers.
        pixels: fractional rows and columns of the points.
        pupil_samples: strata along each side of the pupil.
        seed: of the points in the strata.
    """
    points = imaging.sensor.positions(*pixels)
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), pupil_samples, seed, imaging.system)
    return Survey(
        imaging,
        pixels,
        plane_points(imaging, points, disc),
        _chief(imaging, points),
        pinhole_points(imaging, points),
    )


def _chief(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor] | None:
    try:
        return chief_ray_points(imaging, points)
    except InputError:
        return None


def spread_pixels(sensor: Sensor, count: int) -> Pixels:
    """Rows and columns of `count` points that fill a sensor evenly, each (count,)."""
    index = torch.arange(1, count + 1, dtype=torch.float64)
    down, across = (0.5 + index * _FIRST).frac(), (0.5 + index * _SECOND).frac()
    return down * (sensor.height - 1), across * (sensor.width - 1)
