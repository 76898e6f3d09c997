"""Spots in the linear ray model: every ray's sensor point is linear in the errors of the lens."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.spot_rays import SpotRays
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.tolerancing.through_focus import FocusCurves

_SENSOR = "sensor_distance"


@dataclass(frozen=True)
class LinearSpots:
    """S spots of a lens whose P parameters are off by ε: p(ε) = p + J·ε for every ray.

    RMS² of a spot is then a quadratic form in (1, ε, δ), with δ the way that the sensor is moved
    (mm): its matrix holds the weighted products of the columns d (deviations from the centroid),
    J - J̄ and k (tangents less their mean), summed over the spot's rays, x and y.  What is exact is
    the part of RMS² that is linear in ε; of the quadratic part, the second derivatives of the rays'
    points are missing, which count in proportion to the spot's own size.

    Attributes:
        names: of the parameters.
        centroids: (S, 2), mm.
        centroid_jacobian: (S, 2, P), mm over the parameter's unit (radians for tilts).
        products: (S, P + 2, P + 2), of d, the parameters' columns, and k.
    """

    names: tuple[str, ...]
    centroids: Tensor
    centroid_jacobian: Tensor
    products: Tensor

    @property
    def rms_radii(self) -> Tensor:
        """(S,), mm, of the lens as it is."""
        return self.products[:, 0, 0].sqrt()

    @property
    def rms_jacobian(self) -> Tensor:
        """(S, P): ∂RMS/∂θ = Σ w·(p - p̄)·(J - J̄)/RMS; zero for a perfect spot, which has none."""
        radii = self.rms_radii[:, None]
        return torch.where(radii > 0.0, self.products[:, 0, 1:-1] / radii, 0.0)

    def focus_curves(self, errors: Tensor) -> FocusCurves:
        """RMS² through focus of lenses with these errors.

        Args:
            errors: (..., P), ε, in the lens's units.
        """
        ones = torch.ones_like(errors[..., :1])
        vector = torch.cat([ones, errors], -1)
        square = torch.einsum("...p,spq,...q->...s", vector, self.products[:, :-1, :-1], vector)
        product = vector @ self.products[:, :-1, -1].T
        return FocusCurves(square, product, self.products[:, -1, -1].expand_as(square))


def linear_spots(lens: Lens, spots: SpotRays, names: Sequence[str]) -> LinearSpots:
    """Trace the spots' rays with their derivatives and add up the products.

    Args:
        lens: as designed; single precision limits what is found.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: of the parameters, each a single number; the order is kept.

    Raises:
        InputError: rays that stand for mirror images, or that do not pass the lens.
    """
    check_whole_pupil(spots)
    found = ray_jacobian(lens, spots.rays, list({*names, _SENSOR}))
    if not bool(found.valid.all()):
        raise InputError("rays of the spots do not pass the lens as designed")
    columns = [found.columns[name].start for name in (*names, _SENSOR)]
    rows = torch.cat([found.values[..., None], found.derivatives[..., columns]], -1).double().cpu()
    spot, weight = spots.spot.cpu(), spots.weight.cpu()
    width = rows.shape[-1]
    # (S, 2, 2 + P): where each spot's centroid is, and how it moves.
    means = rows.new_zeros(spots.count, 2, width).index_add_(0, spot, weight[:, None, None] * rows)
    rows = weight.sqrt()[:, None, None] * (rows - means[spot])
    products = torch.stack(
        [mine.T @ mine for mine in (rows[spot == s].reshape(-1, width) for s in range(spots.count))]
    )
    return LinearSpots(tuple(names), means[..., 0], means[..., 1:-1], products)


def check_whole_pupil(spots: SpotRays) -> None:
    """Raise `InputError` where rays stand for their mirror images in a symmetric lens."""
    if bool(spots.centred.any()):
        raise InputError(
            "a perturbed lens has no symmetry: its rays must fill the pupil (symmetry=False)"
        )
