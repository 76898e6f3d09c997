"""Measured moments of spots have a covariance that is known in closed form, and can be
simulated.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.moments import MOMENTS, POWERS, weighted_sums
from dolens.alignment.pixel_moments import (
    check_window,
    convolved,
    observed_radius,
    read_covariance,
)
from dolens.alignment.spot_moments import MomentModel
from dolens.errors import InputError

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
