"""Finely sampled point spread functions all over a sensor: what a plan is made from."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.optics.backend import cpu_kernels_serve
from dolens.optics.system import OpticalSystem
from dolens.rendering.plane_points import (
    PlanePoints,
    chief_ray_points,
    pinhole_points,
    plane_points,
)
from dolens.rendering.psf_grid import (
    sampled_disc,
    splatted,
    wave_cost,
    wave_point_spread_functions,
)
from dolens.rendering.pupil.exit_pupil import ExitPupil, sampled_exit_pupil, working_f_number
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

# The plastic number's sequence fills a square evenly (Roberts, 2018).
_FIRST, _SECOND = 0.7548776662466927, 0.5698402909980532


@dataclass(frozen=True)
class Survey:
    """Rays of points of a sensor, on the planes of a scene.

    Attributes:
        seen: rays of N points.
        chief: rows and columns of the chief rays, each (N, D, C); None where some do not pass.
        pinhole: rows and columns as a pinhole sees the points.
        f_number: that the axial beam works with.
        fused: whether the CPU's kernels splat.
    """

    seen: PlanePoints
    chief: tuple[Tensor, Tensor] | None
    pinhole: tuple[Tensor, Tensor]
    f_number: float
    fused: bool

    def centres(self, distortion: bool) -> tuple[Tensor, Tensor]:
        """What functions are centred on: the chief rays, or a pinhole's points."""
        return self.chief if distortion else self.pinhole

    def offsets(self, distortion: bool) -> PlanePoints:
        """Rays by their distance from the centres."""
        rows, columns = (c[..., None].to(self.seen.rows) for c in self.centres(distortion))
        return PlanePoints(self.seen.rows - rows, self.seen.columns - columns, self.seen.weight)

    def functions(self, size: int, distortion: bool) -> Tensor:
        """(N, D, C, size, size)."""
        return splatted(self.offsets(distortion), size, self.fused).functions

    def waves(
        self,
        system: OpticalSystem,
        scene: PlanarScene,
        sensor: Sensor,
        rows: Tensor,
        columns: Tensor,
        size: int,
        distortion: bool,
    ) -> Tensor:
        """Functions (N, D, C, size, size) with diffraction, of the same points."""
        pupil = sampled_exit_pupil(system, scene.wavelengths, sensor)
        return wave_point_spread_functions(
            system,
            scene,
            sensor.positions(rows, columns),
            pupil,
            sensor.pixel_pitch,
            size,
            distortion,
            # Near enough for a plan; direct integration would take minutes.
            DiffractionSettings(method="fourier"),
        ).functions

    def wave_cost(
        self,
        system: OpticalSystem,
        scene: PlanarScene,
        sensor: Sensor,
        rows: Tensor,
        columns: Tensor,
        size: int,
        distortion: bool,
    ) -> tuple[int, str | None]:
        """Samples along a pupil, and why Fourier transforms do not do, as `field_psf.wave_cost`."""
        return wave_cost(
            system,
            scene,
            sensor.positions(rows, columns),
            sampled_exit_pupil(system, scene.wavelengths, sensor),
            sensor.pixel_pitch,
            size,
            distortion,
        )

    def light(self) -> Tensor:
        """(N, 1, C), relative illumination."""
        return self.seen.weight.sum(-1)


@torch.no_grad()
def survey(
    system: OpticalSystem,
    scene: PlanarScene,
    sensor: Sensor,
    rows: Tensor,
    columns: Tensor,
    pupil_samples: int,
    seed: int = 0,
) -> Survey:
    """Trace rays from pixels (N,), at fractional rows and columns, to the planes of a scene.

    All points share their places in the pupil, so that functions of neighbours are alike in what
    the sampling leaves.
    """
    pupil = sampled_exit_pupil(system, scene.wavelengths, sensor)
    points = sensor.positions(rows, columns)
    disc = sampled_disc(1, pupil_samples, seed, system)
    pitch = sensor.pixel_pitch
    seen = plane_points(system, scene, points, pupil, disc, pitch)
    return Survey(
        seen,
        _chief(system, scene, points, pupil, pitch),
        pinhole_points(points, pitch, len(scene.depths), len(scene.wavelengths)),
        working_f_number(pupil, float(system.vertices[-1])),
        cpu_kernels_serve(system),
    )


def _chief(
    system: OpticalSystem,
    scene: PlanarScene,
    points: tuple[Tensor, Tensor],
    pupil: ExitPupil,
    pitch: float,
) -> tuple[Tensor, Tensor] | None:
    try:
        return chief_ray_points(system, scene, points, pupil, pitch)
    except InputError:
        return None


def spread_pixels(sensor: Sensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of `count` points that fill a sensor evenly, each (count,)."""
    index = torch.arange(1, count + 1, dtype=torch.float64)
    down, across = (0.5 + index * _FIRST).frac(), (0.5 + index * _SECOND).frac()
    return down * (sensor.height - 1), across * (sensor.width - 1)
