"""Sensitivities say how spots change with each tolerance alone; the linear ray model predicts the
mean effect of all, and spots through focus what a compensator wins back.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.system import require_plane_sensor
from dolens.tolerancing.tolerances import Tolerances, fields_all_around

# Rays of a spot over the field: rings of Gaussian quadrature, and arms.
_RINGS, _ARMS = 3, 8


@dataclass(frozen=True)
class FocusCurves:
    """Describes RMS² of spots on a sensor that stands δ (mm) farther from the lens: a + 2b·δ +
    c·δ².

    Rays are straight behind the lens.  A ray lands at d + k·δ from its spot's centroid, with k its
    tangents (l/n, m/n) less their mean, so that with the rays' weights w (which sum to one over a
    spot) a = Σ w·|d|², b = Σ w·d·k and c = Σ w·|k|².

    Attributes:
        mean_square: (..., S), mm², a.
        product: (..., S), mm, b.
        slope_square: (..., S), c.
    """

    mean_square: Tensor
    product: Tensor
    slope_square: Tensor

    def at(self, shift: Tensor | float = 0.0) -> Tensor:
        """Return RMS² (..., S), mm², with the sensor moved by `shift` (..., mm)."""
        if isinstance(shift, Tensor):
            shift = shift[..., None]
        squares = self.mean_square + (2.0 * self.product + self.slope_square * shift) * shift
        # A perfect spot is zero but for rounding.
        return squares.clamp(min=0.0)

    def best_focus(self, weights: Tensor) -> Tensor:
        """Return the shift (...), mm, where Σ W·RMS² is least, δ = -Σ W·b / Σ W·c; zero without
        slopes.

        Args:
            weights: (S,), W of each spot.
        """
        steep = self.slope_square @ weights
        shift = -(self.product @ weights) / torch.where(steep > 0.0, steep, 1.0)
        return torch.where(steep > 0.0, shift, 0.0)


def spot_weights(weights: Tensor | None, spots: int) -> Tensor:
    """Return weights (S,), float64, that sum to one; None stands for equal ones.

    Raises:
        InputError: another number of them, a negative one, or none that is positive.
    """
    if weights is None:
        return torch.full((spots,), 1.0 / spots, dtype=torch.float64)
    weights = torch.as_tensor(weights, dtype=torch.float64)
    if weights.shape != (spots,):
        raise InputError(f"weights: {spots} spots need as many, not {tuple(weights.shape)}")
    if not bool((weights >= 0.0).all()) or not float(weights.sum()) > 0.0:
        raise InputError("weights must not be negative, and one at least positive")
    return weights / weights.sum()


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
    behind = lens.storing_its_values()
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


def spots_over_field(lens: Lens, where: Conditions) -> tuple[SpotRays, Tensor]:
    """Return rays of spots over the whole field, and the weight of each spot.

    Fields are taken on all sides of the axis: a lens with tilted elements has no symmetry.

    Args:
        lens: as designed.
        where: fields and wavelengths with their weights.

    Raises:
        InputError: no light of a field passes.
    """
    where = fields_all_around(where.that_count())
    points, waves, distance = (
        where.fields.tolist(),
        where.wavelengths.tolist(),
        where.object_distance,
    )
    spots = gaussian_quadrature(lens, points, waves, _RINGS, _ARMS, distance, symmetry=False)
    weights = spot_weights(torch.outer(where.field_weights, where.weights).flatten(), spots.count)
    return spots, weights


def linear_spots_over_field(
    lens: Lens, where: Conditions, names: Sequence[str]
) -> tuple[LinearSpots, Tensor]:
    """Return the spots of `spots_over_field` as a linear function of parameters, and their weights.

    Args:
        lens: as designed.
        where: fields and wavelengths with their weights.
        names: of P parameters.

    Raises:
        InputError: no light of a field passes.
    """
    spots, weights = spots_over_field(lens, where)
    return linear_spots(lens, spots, names), weights


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


@dataclass(frozen=True)
class Sensitivities:
    """Holds the spots of a lens, their derivatives, and their sizes at the ends of each tolerance.

    Where a symmetry makes RMS stationary (a tilt on the axis) its derivative is zero and says
    nothing; what a whole tolerance does tells more.

    Attributes:
        names: P parameters.
        steps: (P,), the tolerances Δ in the lens's units.
        centroid_jacobian: (S, 2, P), mm over the parameter's unit (radians for tilts).
        rms: (S,), mm, as designed.
        rms_jacobian: (S, P), mm over the parameter's unit.
        rms_at_ends: (2, P, S), mm, with the parameter off by -Δ and by +Δ, by the linear ray model.
        rms_refocused: (S,), mm, as designed, at the best focus of all spots.
        rms_at_ends_refocused: (2, P, S), mm: every lens at its own best focus.
        weights: (S,), of the spots; they sum to one.
    """

    names: tuple[str, ...]
    steps: Tensor
    centroid_jacobian: Tensor
    rms: Tensor
    rms_jacobian: Tensor
    rms_at_ends: Tensor
    rms_refocused: Tensor
    rms_at_ends_refocused: Tensor
    weights: Tensor

    @property
    def centroid_shifts(self) -> Tensor:
        """Return how far a whole tolerance moves each spot, (S, 2, P), mm."""
        return self.centroid_jacobian * self.steps

    @property
    def largest_centroid_shift(self) -> Tensor:
        """Return the shift (P,), mm, of the spot that the tolerance moves farthest, of those whose
        weight is not zero.
        """
        return self.centroid_shifts[self.weights > 0.0].norm(dim=1).amax(0)

    def increase(self, refocused: bool = True) -> Tensor:
        """Return how much √(Σ W·RMS²) grows at the worse end of each tolerance, (P,), mm."""
        ends = self.rms_at_ends_refocused if refocused else self.rms_at_ends
        start = self.rms_refocused if refocused else self.rms
        overall = (ends.square() @ self.weights).sqrt().amax(0)
        return overall - (start.square() @ self.weights).sqrt()


def sensitivities(model: LinearSpots, steps: Tensor, weights: Tensor) -> Sensitivities:
    """Return the sensitivities to one tolerance at a time.

    Args:
        model: of the lens as designed.
        steps: (P,), Δ of every parameter, in the lens's units.
        weights: (S,), W of each spot, which sum to one; see `spot_weights`.
    """
    ends = torch.stack([-torch.diag(steps), torch.diag(steps)])
    design = model.focus_curves(torch.zeros_like(steps))
    curves = model.focus_curves(ends)
    return Sensitivities(
        model.names,
        steps,
        model.centroid_jacobian,
        design.at().sqrt(),
        model.rms_jacobian,
        curves.at().sqrt(),
        design.at(design.best_focus(weights)).sqrt(),
        curves.at(curves.best_focus(weights)).sqrt(),
        weights,
    )


@dataclass(frozen=True)
class Contributions:
    """Holds what each tolerance adds to M = Σ W·RMS², the mean square radius over the spots.

    In the linear ray model M = M₀ + 2g·ε + εᵀQε.  Errors that are independent and zero on average
    raise it on average by Σ Q_pp·σ_p², exactly, and each tolerance's share adds up with the others.

    Attributes:
        names: P parameters.
        nominal: M₀, mm².
        increase: (P,), mm², Q_pp·σ_p²: the average rise of M by one tolerance alone.
        spread: (P,), mm²: the standard deviation of M by one tolerance alone,
            √(4g_p²σ_p² + Q_pp²(E[ε⁴] - σ_p⁴)).
    """

    names: tuple[str, ...]
    nominal: float
    increase: Tensor
    spread: Tensor

    @property
    def share(self) -> Tensor:
        """Return the share (P,) of the average rise; the shares sum to one."""
        total = self.increase.sum()
        return self.increase / torch.where(total > 0.0, total, 1.0)

    @property
    def expected_rms(self) -> float:
        """Return √(M₀ + Σ increase), mm: the nominal RMS and all tolerances' in root sum square."""
        return float((self.nominal + self.increase.sum()).sqrt())

    @property
    def order(self) -> list[int]:
        """Return the columns, the worst offender first."""
        return torch.argsort(self.increase, descending=True, stable=True).tolist()


def contributions(
    model: LinearSpots, tolerances: Tolerances, weights: Tensor, refocused: bool = True
) -> Contributions:
    """Return averages over the tolerances' distributions, in closed form.

    Args:
        model: of the lens as designed, with the tolerances' parameters.
        tolerances: P of them.
        weights: (S,), W of each spot, which sum to one.
        refocused: whether every lens is put at its best focus.  The focus is one more column of
            the least-squares problem, about the best focus of the lens as designed; what it can
            undo is projected out of all others.
    """
    points, mixed, tangents = (
        torch.einsum("s,spq->pq", weights, form)
        for form in (model.points, model.mixed, model.tangents)
    )
    steep = tangents[0, 0]
    if refocused and float(steep) > 0.0:
        shift = -mixed[0, 0] / steep
        points = points + shift * (mixed + mixed.T) + shift.square() * tangents
        mixed = mixed + shift * tangents
        # Half of ∂RMS²/∂focus, as the errors change it: zero for the design.
        focus = torch.cat([mixed[:1, 0], mixed[1:, 0] + mixed[0, 1:]])
        points = points - torch.outer(focus, focus) / steep
    gradient, curvature = points[0, 1:], points.diagonal()[1:]
    variance = tolerances.variance
    excess = (tolerances.fourth_moment - variance.square()).clamp(min=0.0)
    return Contributions(
        model.names,
        float(points[0, 0]),
        curvature * variance,
        (4.0 * gradient.square() * variance + curvature.square() * excess).sqrt(),
    )
