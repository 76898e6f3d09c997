"""Knots, coefficients and polynomials that the tests of splines share."""

import numpy as np
import torch
from scipy.interpolate import BSpline as SciPySpline

from dolens.optics.surfaces.b_spline import clamped_knots

F64 = torch.float64
# Knots (mm) of every kind that is allowed; "repeated" holds a double, a triple and a quadruple.
KNOTS = {
    "clamped": clamped_knots(5.0, 9),
    "one span": clamped_knots(5.0, 4),
    "uniform, not clamped": [-8.0 + 0.9 * k for k in range(18)],
    "uneven": [-7.0, -6.5, -5.5, -5.0, -4.9, -1.0, 0.3, 0.31, 2.0, 5.0, 5.0, 6.0, 9.0],
    "repeated": [-5.0] * 4
    + [-3.0, -3.0, -1.0, -1.0, -1.0, 0.0, 1.5, 1.5, 1.5, 1.5, 4.0]
    + [5.0] * 4,
}


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def parameters(knots_x, knots_y, seed=0):
    return {
        "coefficients": random(len(knots_y) - 4, len(knots_x) - 4, seed=seed),
        "knots_x": torch.tensor(knots_x, dtype=F64),
        "knots_y": torch.tensor(knots_y, dtype=F64),
    }


def places(knots):
    """Points of a spline: both ends, every knot, and between."""
    low, high = knots[3], knots[-4]
    inner = np.linspace(low, high, 41)
    return torch.tensor(sorted({*inner, *(t for t in knots if low <= t <= high)}), dtype=F64)


def scipy_basis(knots, u, order=0):
    """(points, coefficients): derivatives of every basis function, branch on the right at knots."""
    return SciPySpline(np.array(knots), np.eye(len(knots) - 4), 3)(u.numpy(), nu=order)


def marsden(knots, power):
    """Coefficients of u^power, power ≤ 3 (Marsden's identity): means of products of knots."""
    t = np.array(knots)
    a, b, c = t[1:-3], t[2:-2], t[3:-1]
    return [a * 0 + 1, (a + b + c) / 3, (a * b + b * c + c * a) / 3, a * b * c][power]


def polynomial_spline(knots_x, knots_y, monomials):
    """Coefficients of Σ a·x^i·y^j, from (i, j) → a, as a tensor that is linear in a."""
    return sum(
        a * torch.tensor(np.outer(marsden(knots_y, j), marsden(knots_x, i)))
        for (i, j), a in monomials.items()
    )
