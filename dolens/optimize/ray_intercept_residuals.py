"""Ray intercepts about their references are the residuals of RMS spot radii."""

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor

from dolens.optics.jacobian import normal_equations
from dolens.optics.lens import Lens
from dolens.optimize.linear_model import LinearModel
from dolens.optimize.ray_intercepts import RayInterceptQuality

# More derivatives than this are summed on the way and never stored (400 MB).
MOST_STORED = 50_000_000


class RayInterceptResiduals(RayInterceptQuality):
    """Gives residuals √(W_s·w_i)·(p_i - p̄_s) of every ray i of every spot s, in µm, x and y apart.

    Their sum of squares is Σ W_s·(RMS radius)².  p̄ is the spot's centroid, or where its chief ray
    lands.  Deviations are in mm.
    """

    scale: ClassVar[float] = 1e3
    unit: ClassVar[str] = "um"

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> tuple[LinearModel, Tensor | None]:
        """Return R and b; see `ImageQuality.linear_model`.  Very many rays are summed, never
        stored.
        """
        columns = sum(parameter.numel() for parameter in lens.variables(names).values())
        many = 2 * len(self.spots.weight) * columns > MOST_STORED
        if many and without is None and self._sums_suffice:
            return self._summed(lens, names), None
        return super().linear_model(lens, names, without)

    @property
    def _sums_suffice(self) -> bool:
        return self.reference == "centroid" and not bool(self.spots.centred.any())

    def _summed(self, lens: Lens, names: Sequence[str]) -> LinearModel:
        sums = normal_equations(
            lens, self.spots.rays, names, weight=self.ray_weights, group=self.group
        ).about_centroids()
        model = LinearModel.of_sums(float(sums.sum_of_squares), sums.jtr, sums.jtj)
        return model.scaled(self.scale)
