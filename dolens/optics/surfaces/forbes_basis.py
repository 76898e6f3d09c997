"""Forbes's polynomials Q_bfs, from their recurrence with auxiliary polynomials.

Source: Forbes, Robust, efficient computational methods for axially symmetric optical aspheres,
Opt. Express 18, 19700 (2010).
"""

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
from torch import Tensor


@cache
def _factors(count: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Return f, g and h of P_m = f_m·Q_m + g_(m-1)·Q_(m-1) + h_(m-2)·Q_(m-2) for m < count."""
    f, g, h = [2.0, math.sqrt(19.0) / 2.0], [-0.5], []
    for m in range(2, count):
        h.append(-m * (m - 1) / (2.0 * f[m - 2]))
        g.append(-(1.0 + g[m - 2] * h[m - 2]) / f[m - 1])
        f.append(math.sqrt(m * (m + 1) + 3.0 - g[m - 1] ** 2 - h[m - 2] ** 2))
    return tuple(f), tuple(g), tuple(h)


def q_bfs(q: Tensor, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield Q_m at q = u² and its derivative in q, for m = 0, 1, ..., count - 1.

    The auxiliary polynomials are P_0 = 2, P_1 = 6 - 8q, P_(m+1) = (2 - 4q)·P_m - P_(m-1).
    """
    f, g, h = _factors(count)
    zero = q * 0.0
    here, slope, after, after_slope = zero + 2.0, zero, 6.0 - 8.0 * q, zero - 8.0
    last: list[tuple[Tensor, Tensor]] = []
    for m in range(count):
        value, d = here, slope
        if m > 0:
            value, d = value - g[m - 1] * last[-1][0], d - g[m - 1] * last[-1][1]
        if m > 1:
            value, d = value - h[m - 2] * last[-2][0], d - h[m - 2] * last[-2][1]
        last = [*last[-1:], (value / f[m], d / f[m])]
        yield last[-1]
        factor = 2.0 - 4.0 * q
        here, slope, after, after_slope = (
            after,
            after_slope,
            factor * after - here,
            factor * after_slope - 4.0 * after - slope,
        )


@cache
def to_auxiliary(count: int) -> np.ndarray:
    """Return the matrix (count, count) that takes coefficients of Q_m to those of P_m/2.

    Σ a_m·Q_m = Σ b_m·P_m with P = L·Q, L banded, so that b = L^(-T)·a.  P_m/2 begins with 1.
    """
    f, g, h = _factors(count)
    banded = np.diag(f[:count])
    for m in range(1, count):
        banded[m, m - 1] = g[m - 1]
        if m > 1:
            banded[m, m - 2] = h[m - 2]
    return 2.0 * np.linalg.solve(banded, np.eye(count)).T
