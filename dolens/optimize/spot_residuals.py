"""How far a lens's rays land from where they should, and how that follows from the lens."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.spot_rays import SpotRays
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.rays import Status
from dolens.optimize.linear_model import LinearModel

REFERENCES = ("centroid", "chief")
# More derivatives than this are summed on the way and never stored (400 MB).
MOST_STORED = 50_000_000


def without_edges(lens: Lens) -> Lens:
    """A lens whose apertures clip nothing, with the very parameters of this one.

    A search for a better lens follows the same rays all the way: one that slips out of an aperture
    would otherwise leave its spot, and make it smaller.
    """
    shared = {id(tensor): tensor for tensor in (*lens.parameters(), *lens.buffers())}
    opened = copy.deepcopy(lens, shared)
    for surface in opened.surfaces.values():
        surface.aperture = surface.aperture.opened()
    return opened


@dataclass(frozen=True)
class SpotValues:
    """Spots of a lens.

    Attributes:
        deviations: (N, 2), mm, from the reference point of the ray's spot, double precision.
        tangents: (N, 2), l/n and m/n of every ray on the sensor.
        mean_squares: (S,), mm²: Σ w·|deviation|² of each spot, its RMS radius squared.
        failed: rays that miss a surface or are reflected totally; the rest then says nothing.
        vignetted: the largest share of a spot that the apertures clip; its rays still count.
    """

    deviations: Tensor
    tangents: Tensor
    mean_squares: Tensor
    failed: int
    vignetted: float

    @property
    def rms_radii(self) -> Tensor:
        """(S,), mm."""
        return self.mean_squares.sqrt()


@dataclass(frozen=True)
class SpotResiduals:
    """Residuals √(W_s·w_i)·(p_i - p̄_s) of every ray i of every spot s, x and y apart.

    Their sum of squares is Σ W_s·(RMS radius)².  p̄ is the spot's centroid, or where its chief ray
    lands.

    Args:
        spots: the rays, with chief rays where those are the reference.
        weights: (S,), W of each spot.
        reference: `centroid` or `chief`.
        most_vignetted: share of a spot that apertures may clip before the lens counts as failed: a
            search would else buy sharpness with light.
    """

    spots: SpotRays
    weights: Tensor
    reference: str = "centroid"
    most_vignetted: float = 0.2

    def __post_init__(self) -> None:
        if self.reference not in REFERENCES:
            raise InputError(
                f"reference must be one of {', '.join(REFERENCES)}, not '{self.reference}'"
            )
        if self.reference == "chief" and self.spots.chief is None:
            raise InputError("reference 'chief': these rays hold no chief rays")

    def values(self, lens: Lens) -> SpotValues:
        """Spots of a lens as it is; rays that its apertures clip count as if they did not."""
        spots = self.spots
        with torch.no_grad():
            hit = lens.trace(spots.rays)
        deviations = self._deviations(hit.position[:, :2].double().T).T
        direction = hit.direction.double()
        failed = (hit.status == Status.TIR) | (hit.status == Status.MISSED)
        clipped = spots.weight * (hit.status == Status.VIGNETTED)
        shares = clipped.new_zeros(spots.count).index_add(0, spots.spot, clipped)
        return SpotValues(
            deviations,
            direction[:, :2] / direction[:, 2:],
            self._mean_squares(deviations),
            int(failed.sum()),
            float(shares.amax()),
        )

    def slopes(self, values: SpotValues) -> Tensor:
        """(N, 2), how fast the deviations grow with the distance of the sensor."""
        return self._deviations(values.tangents.T).T

    def best_focus(self, values: SpotValues, slopes: Tensor) -> float:
        """How far to move the sensor (mm) to where the sum of squares is least.

        Rays are straight behind the lens, so that deviations d + k·δz are linear: δz = -d·k/k·k.
        """
        weight = (self._weights * self.spots.weight)[:, None]
        square = float((weight * slopes.square()).sum())
        if square == 0.0 or values.failed:
            return 0.0
        return -float((weight * values.deviations * slopes).sum()) / square

    def refocused(self, values: SpotValues, slopes: Tensor, shift: float) -> SpotValues:
        """The spots on a sensor that stands farther from the lens by `shift` (mm)."""
        deviations = values.deviations + shift * slopes
        return replace(values, deviations=deviations, mean_squares=self._mean_squares(deviations))

    def sum_of_squares(self, values: SpotValues) -> float:
        """Σ W_s·(RMS radius)², mm²; `inf` where rays fail, or too many are clipped."""
        if values.failed or values.vignetted > self.most_vignetted:
            return math.inf
        return float(self.weights.to(values.mean_squares) @ values.mean_squares)

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> LinearModel:
        """R and b in parameters of a lens, columns in the lens's own order.

        Args:
            lens: one `without_edges`.
            names: of its parameters.
            without: (N, 2), deviations by a parameter that is always put where the sum of squares
                is least, as the focus is: what it can undo is taken out of the derivatives
                (variable projection: Golub and Pereyra 1973, in Kaufman's approximation, which
                keeps the gradient exact).
        """
        spots = self.spots
        columns = sum(parameter.numel() for parameter in lens.variables(names).values())
        if 2 * len(spots.weight) * columns > MOST_STORED and without is None and self._sums_suffice:
            return self._summed(lens, names)
        found = ray_jacobian(lens, spots.rays, names)
        # (1 + P, 2, N): neighbouring numbers are those of neighbouring rays.
        rows = torch.cat([found.values.T[None], found.derivatives.permute(2, 1, 0)]).double()
        root = (self._weights * spots.weight).sqrt()
        rows = (self._deviations(rows) * root).reshape(len(rows), -1)
        if without is not None:
            undone = (without.T * root).reshape(-1)
            undone = undone / undone.norm()
            rows = rows - torch.outer(rows @ undone, undone)
        return LinearModel.of_rows(rows[0], rows[1:].T)

    @property
    def _weights(self) -> Tensor:
        """(N,): W of every ray's spot."""
        return self.weights.to(self.spots.weight)[self.spots.spot]

    @property
    def _sums_suffice(self) -> bool:
        return self.reference == "centroid" and not bool(self.spots.centred.any())

    def _deviations(self, points: Tensor) -> Tensor:
        """From p̄ of every ray's spot: of points (..., 2, N), or of derivatives of points."""
        spots = self.spots
        if self.reference == "chief":
            return points - points[..., spots.chief[spots.spot]]
        means = points.new_zeros((*points.shape[:-1], spots.count))
        means.index_add_(-1, spots.spot, points * spots.weight)
        return points - torch.where(spots.centred.T, 0.0, means)[..., spots.spot]

    def _mean_squares(self, deviations: Tensor) -> Tensor:
        squares = self.spots.weight * deviations.square().sum(-1)
        return squares.new_zeros(self.spots.count).index_add(0, self.spots.spot, squares)

    def _summed(self, lens: Lens, names: Sequence[str]) -> LinearModel:
        sums = normal_equations(
            lens,
            self.spots.rays,
            names,
            weight=self._weights * self.spots.weight,
            group=self.spots.spot,
        ).about_centroids()
        return LinearModel.of_sums(float(sums.sum_of_squares), sums.jtr, sums.jtj)
