"""Moments describe spots by sums over rays, which change in a known way when the sensor moves."""

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

# Powers of x and y in the moments of a spot: the centroid, the second and the third moments.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
MOMENTS = len(POWERS)
# Moments that are linear in the ray points, the first of all.
LINEAR = 2
# What the derivatives of these have for factors: one order less.
_LOWER = ((0, 0), *POWERS[:5])


def weighted_sums(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    powers: Sequence[tuple[int, int]],
) -> Tensor:
    """Return Σ w·xⁱ·yʲ of each spot, about an origin and in units of a size.

    Args:
        points: (..., 2, N), mm.
        shares: (N, S), weights w of rays in spots.
        origin: (..., S, 2), mm.
        size: (S,), mm.
        powers: Q pairs (i, j).

    Returns:
        (..., S, Q).
    """
    found = _monomials(points, shares, origin, size, powers)
    return torch.stack([found[..., r] @ w for r, w in _rays_of_spots(shares)], -2)


def sums_and_derivatives(
    points: Tensor, derivatives: Tensor, shares: Tensor, origin: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the moments of `POWERS` and their derivatives, from those of the ray intercepts.

    By the chain rule, about a fixed origin and with a the unit of length,
    ∂⟨xⁱyʲ⟩/∂p = ⟨i·xⁱ⁻¹yʲ·∂X/∂p + j·xⁱyʲ⁻¹·∂Y/∂p⟩/a.

    Args:
        points: (K, 2, N), mm, (X, Y).
        derivatives: (K, 2, F, N), of the points with respect to F parameters.
        shares: (N, S), as in `weighted_sums`, and the rest.
        origin: (K, S, 2), mm.
        size: (S,), mm.

    Returns:
        (K, S, 9) and (K, S, 9, F).
    """
    lower, places = _LOWER, {pair: at for at, pair in enumerate(_LOWER)}
    found = _monomials(points, shares, origin, size, (*lower, *POWERS[len(lower) - 1 :]))
    flat = derivatives.flatten(1, 2).mT
    sums, products = [], []
    for rows, weight in _rays_of_spots(shares):
        sums.append(found[..., rows] @ weight)
        products.append((found[:, : len(lower), rows] * weight) @ flat[:, rows])
    # Σ w·xᵏyˡ·∂X/∂p and Σ w·xᵏyˡ·∂Y/∂p of each spot, (K, S, 6, 2, F).
    means = torch.stack(products, 1).unflatten(-1, derivatives.shape[1:3])
    moments = torch.stack(sums, 1)[..., 1:]
    of_moments = means.new_zeros(*moments.shape, derivatives.shape[2])
    for row, (i, j) in enumerate(POWERS):
        if i:
            of_moments[:, :, row] += i * means[:, :, places[i - 1, j], 0]
        if j:
            of_moments[:, :, row] += j * means[:, :, places[i, j - 1], 1]
    return moments, of_moments / size[:, None, None]


def _monomials(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    powers: Sequence[tuple[int, int]],
) -> Tensor:
    """Return xⁱ·yʲ of each ray, (..., Q, N); arguments as in `weighted_sums`."""
    # Every ray counts in one spot: its origin and its size are picked by that spot.
    spot = shares.argmax(1)
    unit = (points - origin.mT[..., spot]) / size[spot]
    highest = max(max(pair) for pair in powers)
    x, y = ([torch.ones_like(unit[..., axis, :])] for axis in (0, 1))
    for _ in range(highest):
        x.append(x[-1] * unit[..., 0, :])
        y.append(y[-1] * unit[..., 1, :])
    return torch.stack([x[i] * y[j] for i, j in powers], -2)


def _rays_of_spots(shares: Tensor) -> list[tuple[slice | Tensor, Tensor]]:
    """Return the rays of each spot, a slice where they are neighbours, and their weights."""
    spot, weight = shares.argmax(1), shares.sum(1)
    if bool((spot.diff() >= 0).all()):
        parts = weight.split(spot.bincount(minlength=shares.shape[1]).tolist())
        ends = list(accumulate(map(len, parts)))
        return [(slice(end - len(p), end), p) for end, p in zip(ends, parts, strict=True)]
    rows = [torch.nonzero(spot == number)[:, 0] for number in range(shares.shape[1])]
    return [(row, weight[row]) for row in rows]


def shift_derivatives(sums: Tensor, size: Tensor) -> Tensor:
    """Return the derivatives of the moments with respect to the sensor's place in x and in y.

    Light that lands at x lands at x - Δ of a sensor moved by Δ, so that
    ∂⟨xⁱyʲ⟩/∂Δ_x = -i·⟨xⁱ⁻¹yʲ⟩/a about a fixed origin, with a the unit of length.

    Args:
        sums: (..., S, 9), the moments of `POWERS`.
        size: (S,), mm, the unit.

    Returns:
        (..., S, 9, 2), 1/mm.
    """
    padded = torch.cat([sums, torch.ones_like(sums[..., :1])], -1)
    places = {pair: at for at, pair in enumerate((*POWERS, (0, 0)))}
    # With i = 0 the factor is zero, whatever it multiplies.
    lower = [
        [places.get((i - 1, j), MOMENTS) for i, j in POWERS],
        [places.get((i, j - 1), MOMENTS) for i, j in POWERS],
    ]
    factors = sums.new_tensor(POWERS)
    return torch.stack(
        [-factors[:, axis] * padded[..., lower[axis]] / size[:, None] for axis in (0, 1)], -1
    )
