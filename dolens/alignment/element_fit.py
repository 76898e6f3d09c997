"""A fit of measured moments finds the misaligned element of a lens, for many lenses at once.

Every hypothesis is that one element has a pose of its own and all others are as designed; where
the sensor is may be unknown besides.  The moments' covariance is known in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.moments import (
    LINEAR,
    MOMENTS,
    POWERS,
    check_window,
    convolved,
    observed_radius,
    read_covariance,
    weighted_sums,
)
from dolens.alignment.spot_moments import MomentModel
from dolens.errors import InputError
from dolens.optics.lens import Lens

# Lenses at a time: products of moments of all rays take 0.2 GB.
_LENSES_AT_A_TIME = 1 << 6


@torch.no_grad()
def moment_covariance(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    photons: float,
    pitch: float = 0.0,
) -> Tensor:
    """Return the exact covariance of the moments of spots of so many photons each.

    A moment about a fixed origin is the mean over photons of f = xⁱ·yʲ, and the photons land
    independently: cov = (E[f·fᵀ] - E[f]·E[f]ᵀ)/photons, from moments up to the sixth.  With
    pixels, x and y are those of pixels' centres, at any place of the grid (`pixel_moments`).

    Args:
        points: (..., 2, N), mm.
        shares: (N, S).
        origin: (..., S, 2), mm.
        size: (S,), mm.
        photons: of a spot.
        pitch: mm, of pixels; 0: photons are located exactly.

    Returns:
        (..., S, 9, 9), in the units of the moments.
    """
    products = [(i + k, j + m) for i, j in POWERS for k, m in POWERS]
    distinct = list(dict.fromkeys((*POWERS, *products)))
    sums = weighted_sums(points, shares, origin, size, distinct)
    sums = convolved(sums, distinct, pitch / size)
    places = torch.tensor([distinct.index(pair) for pair in products])
    second = sums[..., places].unflatten(-1, (MOMENTS, MOMENTS))
    mean = sums[..., :MOMENTS]
    return (second - mean[..., :, None] * mean[..., None, :]) / photons


@dataclass(frozen=True)
class MeasuredMoments:
    """Holds moments of S spots of K lenses as a sensor gave them.

    With (x, y) about another origin every moment is a linear combination of those up to its own
    order, so χ² is the same about any origin; near the spot, rounding is least.

    Attributes:
        origin: (K, S, 2), mm on the sensor, what moments are about.
        moments: (K, S, 9), in units of the model's sizes.
        factor: (K, S, 9, 9), lower triangular L with covariance L·Lᵀ.
    """

    origin: Tensor
    moments: Tensor
    factor: Tensor

    def __getitem__(self, rows: Tensor) -> "MeasuredMoments":
        return MeasuredMoments(self.origin[rows], self.moments[rows], self.factor[rows])

    def over_noise(self, difference: Tensor) -> Tensor:
        """Return L⁻¹·difference for differences of moments (..., K, S, 9): of unit variance if
        noise.
        """
        return torch.linalg.solve_triangular(self.factor, difference[..., None], upper=False)[
            ..., 0
        ]


@torch.no_grad()
def simulated_moments(
    model: MomentModel, errors: Tensor, photons: float, generator: torch.Generator | None
) -> MeasuredMoments:
    """Simulate what a sensor would measure of lenses with these errors.

    The sums over so many photons are normally distributed about the true moments, by the central
    limit theorem, with all their correlations.  Noise is that of the photons and, where the model
    has pixels, of their reading; shares are counts over their sum in a spot's window.

    Args:
        model: of all the parameters that are off.
        errors: (K, P), in the lens's units.
        photons: of each spot.
        generator: on the CPU; None: no noise, though the covariance is that of the noise.

    Raises:
        InputError: photons out of range, a lens that loses rays, light outside a window, or so few
            rays a spot that its moments are not independent.
    """
    if not photons >= 1.0:
        raise InputError(f"photons: {photons!r}; allowed: 1 or more")
    points = model.points(errors)
    origin = (points @ model.shares).mT
    mean = model.convolved(weighted_sums(points, model.shares, origin, model.size, POWERS))
    covariance = _covariance(model, points, origin, mean, photons)
    factor, failed = torch.linalg.cholesky_ex(covariance)
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    # A pivot of rounding's size is no independent moment.
    pivots = factor.diagonal(dim1=-2, dim2=-1) / spread.clamp(min=torch.finfo(spread.dtype).tiny)
    if bool((failed > 0).any()) or not bool((pivots > 1e-6).all()):
        raise InputError("rings, arms: too few rays for the moments of a spot to be independent")
    moments = mean
    if generator is not None:
        normal = torch.randn(moments.shape, generator=generator, dtype=moments.dtype)
        moments = moments + (factor @ normal[..., None])[..., 0]
    return MeasuredMoments(origin, moments, factor)


def _covariance(
    model: MomentModel, points: Tensor, origin: Tensor, mean: Tensor, photons: float
) -> Tensor:
    """Return the covariance (K, S, 9, 9) of photons and of reading."""
    pixels = model.pixels
    pitch = 0.0 if pixels is None else pixels.pitch
    parts = zip(points.split(_LENSES_AT_A_TIME), origin.split(_LENSES_AT_A_TIME), strict=True)
    covariance = torch.cat(
        [
            moment_covariance(own, model.shares, about, model.size, photons, pitch)
            for own, about in parts
        ]
    )
    if pixels is None:
        return covariance
    check_window(pixels, points, model.shares, origin, observed_radius(mean, model.size))
    return covariance + read_covariance(pixels, origin, mean, model.size, photons)


# Centroids are all but linear in a pose: so few steps on them bring a true hypothesis near.  They
# cannot tell a decentre from a place of the sensor: damped so much, no step goes astray.
_CENTROID_STEPS, _CENTROID_DAMPING = 3, 1e-3
# What a hypothesis moves, of one element.
POSE = ("tilt_x", "tilt_y", "decenter_x", "decenter_y")
# Damping of the first step, its factors after a step that helps and one that does not, and where
# no step can help any more.
_DAMPING, _EASE, _BRAKE, _STUCK = 1e-6, 0.1, 10.0, 1e10
# A fit is done when a step would gain less than this of χ², far below the noise; or, once χ² is
# more than so many times the count of moments, less than a share of the excess: such a hypothesis
# is wrong, and its digits are worth no iterations.
_ENOUGH, _WRONG, _SHARE = 1e-8, 10.0, 0.05


@dataclass(frozen=True)
class ElementFit:
    """Holds the best pose of one element, and place of the sensor, for each of K measurements.

    Attributes:
        errors: (K, P), in the lens's units (radians, mm), in the order of the model's names.
        chi_squared: (K,), Σ (L⁻¹·(m - measured))².
        converged: (K,), bool: no step would gain anything that matters.
        iterations: most that any measurement took.
    """

    errors: Tensor
    chi_squared: Tensor
    converged: Tensor
    iterations: int


def element_names(lens: Lens, element: str) -> tuple[str, ...]:
    """Return the names of an element's tilts and decentres.

    Raises:
        InputError: the lens has no such element.
    """
    names = tuple(f"elements.{element}.{part}" for part in POSE)
    lens.variables(names)
    return names


@torch.no_grad()
def fit_element(model: MomentModel, measured: MeasuredMoments, iterations: int = 20) -> ElementFit:
    """Fit a model's parameters to each measurement by damped Gauss-Newton steps.

    Marquardt's step solves (JᵀJ + λ·diag JᵀJ)·δ = -Jᵀr, with r and J the residuals and their
    derivatives after whitening, and a λ of its own for each measurement.  At the design a
    displaced spot makes cubes of its distance; so centroids are fitted alone first.

    Args:
        model: of the parameters that may be off.
        measured: K measurements of the model's spots.
        iterations: at most, with all moments.
    """
    if iterations < 1:
        raise InputError(f"iterations: {iterations}; allowed: 1 or more")
    return _descend(model, measured, _from_centroids(model, measured), iterations)


@torch.no_grad()
def information_root(model: MomentModel, measured: MeasuredMoments, errors: Tensor) -> Tensor:
    """Return R, upper triangular, where RᵀR = JᵀJ is the Fisher information of these moments.

    The first rows and columns of R are the R of the first parameters alone, the others known.

    Args:
        model: of P parameters.
        measured: K measurements, whose noise counts; what they measured does not.
        errors: (K, P), where the lenses truly are.

    Returns:
        (K, P, P), in the inverse of the lens's units.
    """
    _, jacobian = _whitened(model, measured, errors)
    # Radians and mm side by side: columns of one length keep digits.
    length = jacobian.norm(dim=1, keepdim=True)
    return torch.linalg.qr(jacobian / length, mode="r").R * length


def least_covariance(root: Tensor) -> Tensor:
    """Return the Cramér–Rao bound (RᵀR)⁻¹ on the covariance of unbiased estimates.

    A block of it is the covariance of some parameters with all others unknown.

    Args:
        root: (K, P, P), upper triangular.

    Returns:
        (K, P, P), in the lens's units squared.
    """
    length = root.norm(dim=1, keepdim=True)
    inverse = torch.linalg.inv(root / length) / length.mT
    return inverse @ inverse.mT


def most_likely_element(chi_squared: Sequence[Tensor] | Tensor) -> tuple[Tensor, Tensor]:
    """Return the element that explains each measurement best, and its posterior probability.

    Hypotheses have equally many parameters and equal priors; a hypothesis's share is
    exp(-χ²/2) over the sum of all.

    Args:
        chi_squared: (E, K), of each element's fit.

    Returns:
        Numbers of elements (K,), and shares (E, K) that sum to one over elements.
    """
    table = chi_squared if isinstance(chi_squared, Tensor) else torch.stack(list(chi_squared))
    return table.argmin(0), torch.softmax(-0.5 * table, 0)


def _from_centroids(model: MomentModel, measured: MeasuredMoments) -> Tensor:
    """Return parameters (K, P) that all but explain the centroids.

    Damped steps with the derivatives of the design throughout, which are the same for all.
    """
    design = measured.moments.new_zeros(1, len(model.names))
    _, jacobian = model.moments_and_jacobian(design, model.centroids[None])
    # The first rows of a triangular factor are that of the first moments alone.
    factor = measured.factor[..., :LINEAR, :LINEAR]
    slopes = torch.linalg.solve_triangular(factor, jacobian[:, :, :LINEAR], upper=False)
    slopes = slopes.flatten(1, 2)
    damping = torch.full_like(measured.moments[:, 0, 0], _CENTROID_DAMPING)
    errors = design.expand(len(damping), -1)
    for _ in range(_CENTROID_STEPS):
        apart = (model.moments(errors, measured.origin) - measured.moments)[..., :LINEAR, None]
        white = torch.linalg.solve_triangular(factor, apart, upper=False)
        errors = errors + _damped_step(white.flatten(1), slopes, damping)
    return errors


def _descend(
    model: MomentModel, measured: MeasuredMoments, start: Tensor, iterations: int
) -> ElementFit:
    """Make Marquardt's steps with all moments."""
    errors = start.clone()
    residual, jacobian = _whitened(model, measured, errors)
    cost = residual.square().sum(-1)
    damping = torch.full_like(cost, _DAMPING)
    converged = torch.zeros_like(cost, dtype=torch.bool)
    used = 0
    while used < iterations:
        # Those that are done are left out, so that the slowest cost little.
        at = torch.nonzero(~converged & (damping < _STUCK))[:, 0]
        if len(at) == 0:
            break
        used += 1
        r, j = residual[at], jacobian[at]
        step = _damped_step(r, j, damping[at])
        gain = r.square().sum(-1) - (r + (j @ step[..., None])[..., 0]).square().sum(-1)
        tried = errors[at] + step
        new_residual, new_jacobian = _whitened(model, measured[at], tried)
        new_cost = new_residual.square().sum(-1)
        better = new_cost < cost[at]
        excess = (cost[at] - _WRONG * residual.shape[1]).clamp(min=0.0)
        converged[at] = gain < _ENOUGH + _SHARE * excess
        damping[at] *= torch.where(better, _EASE, _BRAKE)
        kept = at[better]
        errors[kept], cost[kept] = tried[better], new_cost[better]
        residual[kept], jacobian[kept] = new_residual[better], new_jacobian[better]
    return ElementFit(errors, cost, converged, used)


def _damped_step(residual: Tensor, jacobian: Tensor, damping: Tensor) -> Tensor:
    """Return the damped step (K, P), solved with the parameters scaled to columns of unit
    length.
    """
    length = jacobian.norm(dim=1)
    unit = jacobian / length[:, None]
    normal = unit.mT @ unit + torch.diag_embed(damping[:, None].expand_as(length))
    gradient = unit.mT @ residual[..., None]
    return -torch.linalg.solve(normal, gradient)[..., 0] / length


def _whitened(
    model: MomentModel, measured: MeasuredMoments, errors: Tensor
) -> tuple[Tensor, Tensor]:
    """Return residuals (K, S·9) of unit variance, and their derivatives (K, S·9, P)."""
    moments, jacobian = model.moments_and_jacobian(errors, measured.origin)
    both = torch.cat([(moments - measured.moments)[..., None], jacobian], -1)
    white = torch.linalg.solve_triangular(measured.factor, both, upper=False)
    return white[..., 0].flatten(1), white[..., 1:].flatten(1, 2)
