"""In the linear ray model every ray intercept is linear in the errors of the lens."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.straight import require_plane_sensor
from dolens.tolerancing.through_focus import FocusCurves


@dataclass(frozen=True)
class LinearSpots:
    """Describes S spots of a lens whose P parameters are off by ε: p(ε) = p + J·ε for every ray.

    With the sensor moved by δ (mm) a ray lands at p + J·ε + δ·(t + T·ε), where t are its tangents
    (l/n, m/n) and T = ∂t/∂ε.  So RMS² of a spot is Σ w·|D·v + δ·K·v|² with v = (1, ε), and D and K
    the columns (p, J) and (t, T) less their means over the spot: three quadratic forms in v.

    What is exact is the part of RMS² that is linear in ε.  Of its quadratic part, the second
    derivatives of the rays' points are missing; they count in proportion to the spot's own size.

    Attributes:
        names: of the parameters.
        centroids: (S, 2), mm.
        centroid_jacobian: (S, 2, P), mm over the parameter's unit (radians for tilts).
        points: (S, 1 + P, 1 + P), mm², the products Σ w·DᵀD, x and y together.
        mixed: (S, 1 + P, 1 + P), mm, Σ w·DᵀK.
        tangents: (S, 1 + P, 1 + P), Σ w·KᵀK.
    """

    names: tuple[str, ...]
    centroids: Tensor
    centroid_jacobian: Tensor
    points: Tensor
    mixed: Tensor
    tangents: Tensor

    def some(self, chosen: Tensor) -> "LinearSpots":
        """Return the spots where `chosen` (S,), bool, is true."""
        of_spots = (
            *(self.centroids, self.centroid_jacobian),
            *(self.points, self.mixed, self.tangents),
        )
        return LinearSpots(self.names, *(values[chosen] for values in of_spots))

    @property
    def rms_radii(self) -> Tensor:
        """Return the RMS radii (S,), mm, of the lens as it is."""
        return self.points[:, 0, 0].sqrt()

    @property
    def rms_jacobian(self) -> Tensor:
        """Return ∂RMS/∂θ (S, P) = Σ w·(p - p̄)·(J - J̄)/RMS; zero for a perfect spot, which has
        none.
        """
        radii = self.rms_radii[:, None]
        return torch.where(radii > 0.0, self.points[:, 0, 1:] / radii, 0.0)

    def focus_curves(self, errors: Tensor) -> FocusCurves:
        """Return RMS² through focus of lenses with these errors.

        Args:
            errors: (..., P), ε, in the lens's units.
        """
        vector = torch.cat([torch.ones_like(errors[..., :1]), errors], -1)
        forms = (self.points, self.mixed, self.tangents)
        return FocusCurves(
            *(torch.einsum("...p,spq,...q->...s", vector, form, vector) for form in forms)
        )


def linear_spots(lens: Lens, spots: SpotRays, names: Sequence[str]) -> LinearSpots:
    """Trace the spots' rays with their derivatives and add up the products.

    Args:
        lens: as designed; single precision limits what is found.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: of the parameters, each a single number; the order is kept.

    Raises:
        InputError: rays that stand for mirror images, or that do not pass the lens, or a curved
            sensor.
    """
    check_whole_pupil(spots)
    require_plane_sensor(lens.system(), "tolerances")
    # Rays are straight behind the lens: their points on a second sensor give the tangents exactly.
    behind = copy.deepcopy(lens)
    with torch.no_grad():
        behind.sensor_distance.add_(1.0)
    points = _points(lens, spots, names)
    rows = torch.stack([points, _points(behind, spots, names) - points], -1)
    spot, weight = spots.spot.cpu(), spots.weight.cpu()[:, None, None, None]
    # (S, 2, 1 + P, 2): where each spot's centroid is, how it moves; and so its mean tangents.
    means = rows.new_zeros(spots.count, *rows.shape[1:]).index_add_(0, spot, weight * rows)
    rows = weight.sqrt() * (rows - means[spot])
    d, k = rows.unbind(-1)
    forms = []
    for left, right in ((d, d), (d, k), (k, k)):
        pairs = (
            (left[spot == s].flatten(0, 1), right[spot == s].flatten(0, 1))
            for s in range(spots.count)
        )
        forms.append(torch.stack([a.T @ b for a, b in pairs]))
    return LinearSpots(tuple(names), means[..., 0, 0], means[..., 1:, 0], *forms)


def _points(lens: Lens, spots: SpotRays, names: Sequence[str]) -> Tensor:
    """Return p and J of every ray, (N, 2, 1 + P), double precision."""
    found = ray_jacobian(lens, spots.rays, list(names))
    if not bool(found.valid.all()):
        raise InputError("rays of the spots do not pass the lens as designed")
    columns = [found.columns[name].start for name in names]
    return torch.cat([found.values[..., None], found.derivatives[..., columns]], -1).double().cpu()


def check_whole_pupil(spots: SpotRays) -> None:
    """Raise `InputError` where rays stand for their mirror images in a symmetric lens."""
    if bool(spots.centred.any()):
        raise InputError(
            "a perturbed lens has no symmetry: its rays must fill the pupil (symmetry=False)"
        )
