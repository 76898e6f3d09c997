"""Merit terms of ray intercepts share the deviations of rays from the reference of their spot."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.rays import TracedRays
from dolens.optimize.image_quality import ImageQuality


class RayInterceptQuality(ImageQuality):
    """Measures image quality by ray intercepts: x and y on the sensor, mm, from the centroid or the
    chief ray.
    """

    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        direction = hit.direction.double()
        points = self._referenced(hit.position[:, :2].double().T)
        return points, (direction[:, :2] / direction[:, 2:]).T

    def _slopes(self, growth: Tensor) -> Tensor:
        return self._referenced(growth)

    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        found = ray_jacobian(lens, self.spots.rays, names)
        # (1 + P, 2, N): neighbouring numbers are those of neighbouring rays.
        rows = torch.cat([found.values.T[None], found.derivatives.permute(2, 1, 0)])
        return self._referenced(rows.double())
