"""Moments describe spots by sums over rays, which change in a known way when the sensor moves."""

from collections.abc import Sequence

import torch
from torch import Tensor

# Powers of x and y in the moments of a spot: the centroid, the second and the third moments.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
MOMENTS = len(POWERS)
# Moments that are linear in the ray points, the first of all.
LINEAR = 2


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
    # Every ray counts in one spot: its origin and its size are picked by that spot.
    own = (shares > 0.0).to(shares)
    unit = (points - origin.mT @ own.mT) / (own @ size)
    highest = max(max(pair) for pair in powers)
    x, y = ([torch.ones_like(unit[..., axis, :])] for axis in (0, 1))
    for _ in range(highest):
        x.append(x[-1] * unit[..., 0, :])
        y.append(y[-1] * unit[..., 1, :])
    return (torch.stack([x[i] * y[j] for i, j in powers], -2) @ shares).mT


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
