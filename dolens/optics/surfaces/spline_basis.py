"""A cubic spline of one variable has knots, and at each point four basis functions that are not
zero.

n coefficients need n + 4 knots t_0 ≤ ... ≤ t_(n+3); the spline lives on [t_3, t_n].  A knot of
multiplicity m leaves 3 - m continuous derivatives there: two at a simple knot, a crease at a
triple one, a step at a quadruple one.  At such a knot the branch on its right is taken, and at
the last knot the one on its left.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError

# Knots this much closer than the spline is wide would be neither one knot nor two in float32.
RESOLUTION = 1e-6


class CubicBasis(NamedTuple):
    """At points u these are the basis functions N_(span-3), ..., N_span and their derivatives.

    Attributes:
        first: index of the first of the four, span - 3 (int64, shape of u).
        value: (4, ...), N.
        slope: (4, ...), dN/du, 1/mm.
        second_derivative: (4, ...), d²N/du², 1/mm²; None when it was not asked for.
    """

    first: Tensor
    value: Tensor
    slope: Tensor
    second_derivative: Tensor | None


def clamped_knots(half_width: float, count: int) -> list[float]:
    """Return knots for `count` coefficients on [-half_width, half_width] (mm), equally spaced.

    The first and the last are quadruple, so that the spline ends on its outermost coefficients.

    Raises:
        InputError: a width that is not positive, or fewer than four coefficients.
    """
    if count < 4:
        raise InputError(f"a cubic spline has at least 4 coefficients a side, not {count}")
    if not 0.0 < half_width < float("inf"):
        raise InputError(f"half width must be a positive number of mm, not {half_width}")
    spans = count - 3
    inner = [half_width * ((2 * k - spans) / spans) for k in range(spans + 1)]
    return [inner[0]] * 3 + inner + [inner[-1]] * 3


def check_knots(knots: Sequence[float], count: int, name: str) -> None:
    """Raise `InputError` unless knots (mm) are a cubic spline's with `count` coefficients.

    They must not decrease, distinct ones must be distinct in float32 too, and each coefficient
    must have an effect: no knot more than quadruple, and none outside [t_3, t_n] at its ends.
    """
    if len(knots) != count + 4:
        raise InputError(
            f"'{name}' must have {count + 4} knots, 4 more than there are coefficients in that "
            f"direction, not {len(knots)}"
        )
    if any(not abs(knot) < float("inf") for knot in knots):
        raise InputError(f"'{name}' must be finite numbers (mm)")
    nearest = RESOLUTION * (knots[count] - knots[3])
    for before, after in pairwise(knots):
        if after < before:
            raise InputError(f"'{name}' must not decrease, as from {before:g} to {after:g}")
        if 0.0 < after - before < nearest:
            raise InputError(
                f"'{name}': {before!r} and {after!r} are too close; repeat a knot exactly, or "
                f"leave {nearest:g} mm between"
            )
    for first, last in zip(knots[:-4], knots[4:], strict=True):
        if first == last:
            raise InputError(f"'{name}': knot {first:g} is repeated more than 4 times")
    for inner, outer in ((knots[4], knots[3]), (knots[count - 1], knots[count])):
        if inner == outer:
            raise InputError(
                f"'{name}': {outer:g} ends the spline (the fourth knot from either end does) and "
                "must not be repeated inwards"
            )


def cubic_basis(knots: Tensor, u: Tensor, second: bool = False) -> CubicBasis:
    """Evaluate the four cubic B-splines that are not zero at u, by Cox's and de Boor's recurrence.

    On its own span, t_i ≤ u < t_(i+1) with t_i < t_(i+1), every denominator of the recurrence
    spans at least that interval, so the 0/0 of repeated knots never arises.  The derivative shares
    its terms: N' = 3(Q_k/d_k - Q_(k+1)/d_(k+1)) with the quadratic B-splines Q (de Boor, A
    Practical Guide to Splines, ch. X).  The cost does not depend on the number of knots, except
    for the bisection that finds the span.

    Beyond an end e each function goes on along its tangent, N(e) + (u - e)·N'(e); at the end
    itself all derivatives are those inside.

    Args:
        knots: (n + 4,), mm; nothing differentiates with respect to them.
        u: mm.
        second: whether to return second derivatives.
    """
    knots = knots.detach()
    count = knots.shape[-1] - 4
    # Not by clamp, which halves the derivative at the ends.
    low, high = knots[3], knots[count]
    inside = torch.where(u < low, low, torch.where(u > high, high, u))
    beyond = u - inside
    first = torch.searchsorted(knots[4:count].contiguous(), u.detach().contiguous(), right=True)
    around = first + torch.arange(1, 7, device=u.device).view(6, *[1] * u.dim())
    # The knots t_(i-2) ... t_(i+3) about the span [t_i, t_(i+1)].
    a, b, c, d, e, f = knots.index_select(0, around.reshape(-1)).reshape(around.shape).unbind()
    after_a, after_b, after_c = inside - a, inside - b, inside - c
    to_d, to_e, to_f = d - inside, e - inside, f - inside
    # Linear, quadratic and cubic B-splines; p and q are over the widths of their own supports.
    span = 1.0 / (d - c)
    p0, p1 = to_d * span / (d - b), after_c * span / (e - c)
    q0 = to_d * p0 / (d - a)
    q1 = torch.addcmul(after_b * p0, to_e, p1) / (e - b)
    q2 = after_c * p1 / (f - c)
    value = torch.stack(
        (
            to_d * q0,
            torch.addcmul(after_a * q0, to_e, q1),
            torch.addcmul(after_b * q1, to_f, q2),
            after_c * q2,
        )
    )
    slope = 3.0 * torch.stack((-q0, q0 - q1, q1 - q2, q2))
    second_derivative = None
    if second:
        r0, r1, r2 = -p0 / (d - a), (p0 - p1) / (e - b), p1 / (f - c)
        second_derivative = 6.0 * torch.stack((-r0, r0 - r1, r1 - r2, r2))
        second_derivative = torch.where(
            beyond == 0.0, second_derivative, torch.zeros_like(second_derivative)
        )
    return CubicBasis(first, torch.addcmul(value, beyond, slope), slope, second_derivative)
