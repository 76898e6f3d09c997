"""Jacobi polynomials P_k^(0, m)(2q - 1) on 0 ≤ q ≤ 1, by their three-term recurrence.

They are the radial part of Zernike's polynomials, R_n^m(ρ) = ρ^m·P_k^(0, m)(2ρ² - 1) with
k = (n - m)/2, and with m = 4 Forbes's Q_con.  Recurrence keeps them accurate to any order, where
powers of q with their alternating coefficients would lose all digits.
"""

from collections.abc import Iterator
from functools import cache

import torch
from torch import Tensor


@cache
def recurrence(k: int, m: int) -> tuple[float, float, float]:
    """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2), for k ≥ 1.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 22.7.1, at x = 2q - 1.
    """
    if k == 1:
        return m + 2.0, -(m + 1.0), 0.0
    lower, here, both = 2 * k + m - 2, 2 * k + m - 1, 2 * k + m
    scale = 2 * k * (k + m) * lower
    slope = here * both * lower / scale
    return 2.0 * slope, -here * m * m / scale - slope, 2 * (k - 1) * (k + m - 1) * both / scale


def jacobi(q: Tensor, m: int, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield P_k^(0, m)(2q - 1) and its derivative in q, for k = 0, 1, ..., count - 1."""
    value, slope = torch.ones_like(q), torch.zeros_like(q)
    lower, lower_slope = torch.zeros_like(q), torch.zeros_like(q)
    for k in range(count):
        if k > 0:
            a, b, c = recurrence(k, m)
            factor = a * q + b
            value, lower, slope, lower_slope = (
                factor * value - c * lower,
                value,
                factor * slope + a * value - c * lower_slope,
                slope,
            )
        yield value, slope
