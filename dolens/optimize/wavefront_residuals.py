"""Optical path differences from reference spheres are the residuals of RMS wavefront errors."""

from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.rays import TracedRays
from dolens.optics.system import require_plane_sensor
from dolens.optimize.image_quality import ImageQuality

_OUTPUTS = ("x", "y", "path_length", "l", "m")
_MM_PER_NM = 1e-6


class WavefrontResiduals(ImageQuality):
    """Gives residuals √(W_s·w_i)·(OPD_i - mean OPD of spot s), in wavelengths.

    Their sum of squares is Σ W_s·(RMS wavefront error)².  The optical path difference is the path
    from the object's wavefront to a sphere about the reference point (X, Y) on the sensor, centroid
    or chief ray.  The sphere is taken as very large: with the ray's sensor point (x, y), direction
    (l, m), path V and the index n' before the sensor,

        OPD = V - n'·((x - X)·l + (y - Y)·m) - its mean,

    which differs from that on a sphere of radius R by n'·|p - p̄|²/2R at most, some hundredths of a
    wavelength for spots of 20 µm and R = 50 mm, and nothing for good lenses.

    Raises:
        InputError: a lens in single precision, whose paths are known to a few wavelengths only.
    """

    unit: ClassVar[str] = "waves"

    @property
    def _numbers(self) -> int:
        return 1

    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        self._check(lens)
        position, direction = hit.position[:, :2].T, hit.direction[:, :2].T
        path = hit.path_length + self._path_before(lens)
        deviations = self._differences(lens, position, direction, path)
        # Moving the sensor by δz moves the sphere's centre along the chief ray: OPD grows by
        # n'·(l·c_x + m·c_y + n)·δz, with c the reference point's own tangents.
        tangents = (hit.direction[:, :2] / hit.direction[:, 2:]).T
        centre = self._reference_points(tangents)
        growth = (direction * centre).sum(0) + hit.direction[:, 2]
        return deviations, (self._index(lens) / self._waves * growth)[None]

    def _slopes(self, growth: Tensor) -> Tensor:
        return self._without_piston(growth)

    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        self._check(lens)
        found = ray_jacobian(lens, self.spots.rays, names, _OUTPUTS)
        values = found.values.T
        jacobian = found.derivatives.permute(2, 1, 0)
        position, path, direction = values[:2], values[2], values[3:]
        opd = self._differences(lens, position, direction, path + self._path_before(lens))
        away = self._referenced(position)
        # d(OPD) = dV - n'·(dp - dp̄)·(l, m) - n'·(p - p̄)·d(l, m)
        moved = self._referenced(jacobian[:, :2]) * direction + away * jacobian[:, 3:]
        change = (jacobian[:, 2] - self._index(lens) * moved.sum(1)) / self._waves
        return torch.cat([opd[None], self._without_piston(change)[:, None]])

    # ---------------------------------------------------------------- the path difference

    def _differences(self, lens: Lens, position: Tensor, direction: Tensor, path: Tensor) -> Tensor:
        """Return the optical path differences (1, N), wavelengths."""
        tilt = (self._referenced(position) * direction).sum(0)
        return self._without_piston((path - self._index(lens) * tilt) / self._waves)[None]

    def _without_piston(self, values: Tensor) -> Tensor:
        """Return values (..., N) less their mean over each spot."""
        spots = self.spots
        means = values.new_zeros((*values.shape[:-1], spots.count))
        means.index_add_(-1, spots.spot, values * spots.weight)
        return values - means[..., spots.spot]

    def _index(self, lens: Lens) -> Tensor:
        """Return the index n' (N,) before the sensor."""
        return torch.as_tensor(lens.system().materials[-1].index(self._wavelengths))

    def _path_before(self, lens: Lens) -> Tensor:
        """Return the path (N,), mm, from the object's wavefront to where the rays begin."""
        spots = self.spots
        position, direction = spots.rays.position, spots.rays.direction
        index = lens.materials[0].index(self._wavelengths)
        if lens.object_distance is None:
            return index * (position * direction).sum(-1)
        point = torch.nn.functional.pad(spots.fields, (0, 1), value=-lens.object_distance)
        return index * (position - point.to(position)[spots.spot]).norm(dim=-1)

    @property
    def _wavelengths(self) -> Tensor:
        return self.spots.wavelengths.to(self.spots.weight)[self.spots.spot]

    @cached_property
    def _waves(self) -> Tensor:
        """Return each ray's wavelength (N,), mm."""
        return _MM_PER_NM * self._wavelengths

    def _check(self, lens: Lens) -> None:
        if lens.dtype != torch.float64:
            raise InputError("merit.quality 'wavefront' needs double precision: lens_dtype=float64")
        require_plane_sensor(lens.system(), "merit.quality 'wavefront'")
