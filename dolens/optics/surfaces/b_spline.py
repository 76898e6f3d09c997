"""A freeform surface may be a cubic B-spline (S7, S8), a product of splines in x and in y.

A cubic spline of one variable has knots, and at each point four basis functions that are not
zero.

n coefficients need n + 4 knots t_0 ≤ ... ≤ t_(n+3); the spline lives on [t_3, t_n].  A knot of
multiplicity m leaves 3 - m continuous derivatives there: two at a simple knot, a crease at a
triple one, a step at a quadruple one.  At such a knot the branch on its right is taken, and at
the last knot the one on its left.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError, check_keys
from dolens.kernels.cubics import b_splines, b_splines_second
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names, tensor_of
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.registry import register_surface


class SplineSag(NamedTuple):
    """A spline gives sag (mm), slopes, and second derivatives (1/mm; None if not asked for)."""

    s: Tensor
    sx: Tensor
    sy: Tensor
    sxx: Tensor | None = None
    sxy: Tensor | None = None
    syy: Tensor | None = None


def spline_sag(p: Parameters, x: Tensor, y: Tensor, second: bool = False) -> SplineSag:
    """Return s = Σ c_ji·N_j(y)·N_i(x) and its derivatives in one pass, from the 4×4 coefficients of
    each point.

    Beyond the knot rectangle the surface goes on straight: along its tangent past an edge, and
    past a corner as s + Δx·s_x + Δy·s_y + Δx·Δy·s_xy.  Value and slopes stay continuous.

    Args:
        p: `coefficients` (rows, columns) for (y, x), mm; `knots_x` (columns + 4,) and `knots_y`
            (rows + 4,), mm.
        x: mm.
        y: mm, of a shape that broadcasts with x.
        second: whether to return second derivatives.
    """
    x, y = torch.broadcast_tensors(x, y)
    columns = p["coefficients"].shape[-1]
    bx, by = cubic_basis(p["knots_x"], x, second), cubic_basis(p["knots_y"], y, second)
    steps = torch.arange(4, device=x.device)
    steps = (columns * steps[:, None] + steps).view(4, 4, *[1] * x.dim())
    index = columns * by.first + bx.first + steps
    # index_select has a sum over the rays as its derivative, without sorting them.
    c = p["coefficients"].reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)
    # The basis sums to one and its derivatives to zero, so any level can be taken off first:
    # rounding is then that of the differences between neighbours.
    level = c[1, 1].detach()
    c = c - level
    row, row_x = (c * bx.value).sum(1), (c * bx.slope).sum(1)
    s = level + (row * by.value).sum(0)
    sx, sy = (row_x * by.value).sum(0), (row * by.slope).sum(0)
    if bx.second_derivative is None or by.second_derivative is None:
        return SplineSag(s, sx, sy)
    sxx = ((c * bx.second_derivative).sum(1) * by.value).sum(0)
    return SplineSag(s, sx, sy, sxx, (row_x * by.slope).sum(0), (row * by.second_derivative).sum(0))


@register_surface
class BSpline(Surface):
    """The sag is z = Σ c_ji·N_j(y)·N_i(x) with cubic B-splines N on a rectangle of knots (S7).

    A prescription gives `coefficients`, rows along y and columns along x, and either `knots_x`
    and `knots_y` or `half_width` (or `half_width_x` and `half_width_y`) for equally spaced knots
    on [-half_width, half_width], quadruple at the ends.  The sag at the vertex is whatever the
    coefficients make it.

    The rectangle must hold the clear aperture.  A ray that meets the surface on or beyond the
    rectangle's edge misses it: the margin is the distance in mm to the nearest edge, and negative
    outside.  There the surface is continued straight (`spline_sag`), so that Newton's iteration
    may pass through, and its numbers stay finite.
    """

    kind = "b_spline"
    kernel = SurfaceKernel("dolens.kernels.cpu.b_spline", "dolens.kernels.cuda.b_spline")
    constants = ("knots_x", "knots_y")
    arrays = ("coefficients", "knots_x", "knots_y")
    optional = ("coefficients", "knots_x", "knots_y", "half_width", "half_width_x", "half_width_y")

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(aperture, with_knots(parameters), dtype)

    def check_aperture(self) -> None:
        """Check that the knots fit the coefficients and that their rectangle holds the aperture."""
        rows, columns = self.get_parameter("coefficients").shape
        extents = self.aperture.edge.extent
        for axis, count, extent in zip("xy", (columns, rows), extents, strict=True):
            knots = self.get_buffer(f"knots_{axis}").tolist()
            check_knots(knots, count, f"knots_{axis}")
            reach = min(-knots[3], knots[count])
            if extent > reach:
                raise InputError(
                    f"the aperture reaches {extent:g} mm and exceeds the surface, whose knots "
                    f"'knots_{axis}' end at {axis} = {knots[3]:g} and {knots[count]:g} mm"
                )

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return coefficients and knots, or the half widths that the knots are made from."""
        return list(cls.optional)

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag (S7), slopes (S8), and the distance to the knot rectangle's nearest edge."""
        sag, sx, sy, *_ = spline_sag(p, x, y)
        return sag, sx, sy, torch.minimum(_inside(p["knots_x"], x), _inside(p["knots_y"], y))

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return knots in x, knots in y, coefficients."""
        rows, columns = p["coefficients"].shape
        numbers = (p["knots_x"], p["knots_y"], p["coefficients"])
        return PackedShape(numbers, count=rows, columns=columns)

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return (s_xx + s_yy)/2 at x = y = 0: the mean over azimuth."""
        zero = p["knots_x"].new_zeros(())
        _, _, _, sxx, _, syy = spline_sag(p, zero, zero, second=True)
        assert sxx is not None and syy is not None  # they were asked for
        return 0.5 * (sxx + syy)


def with_knots(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return coefficients and knots; the knots are made from the half widths where those are given
    instead.

    Raises:
        InputError: coefficients that are no matrix of at least 4×4, knots that are missing or
            given twice, an unknown name.
    """
    given = dict(parameters)
    check_keys(given, BSpline.optional, "b_spline")
    if "coefficients" not in given:
        raise InputError("'coefficients' are missing (mm; rows along y, columns along x)")
    shape = tuple(tensor_of(given["coefficients"], "coefficients", torch.float64).shape)
    if len(shape) != 2 or min(shape) < 4:
        raise InputError(
            "'coefficients' must be at least 4 rows (y) of at least 4 numbers (x), not "
            + (" × ".join(map(str, shape)) or "one number")
        )
    for axis, count in (("x", shape[1]), ("y", shape[0])):
        names = (f"knots_{axis}", f"half_width_{axis}", "half_width")
        found = [name for name in names if name in given]
        if len(found) != 1:
            raise InputError(
                f"give one of '{names[0]}', '{names[1]}' and 'half_width' (mm), not "
                f"{' and '.join(map(repr, found)) or 'none'}"
            )
        if found[0] != names[0]:
            given[names[0]] = clamped_knots(float(given[found[0]]), count)
        elif tensor_of(given[names[0]], names[0], torch.float64).dim() != 1:
            raise InputError(f"'{names[0]}' must be one list of numbers (mm)")
    return {name: given[name] for name in BSpline.arrays}


def _inside(knots: Tensor, u: Tensor) -> Tensor:
    """Return the distance (mm) to the nearer end of the spline, negative beyond it."""
    u = u.detach()
    return torch.minimum(u - knots[3], knots[-4] - u)


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
    """Evaluate the four cubic B-splines that are not zero at u; see `kernels.cubics.b_splines`.

    On its own span, t_i ≤ u < t_(i+1) with t_i < t_(i+1), the 0/0 of repeated knots never arises.
    The cost does not depend on the number of knots, except for the bisection that finds the span.
    Beyond an end each function goes on along its tangent; at the end itself all derivatives are
    those inside.

    Args:
        knots: (n + 4,), mm; nothing differentiates with respect to them.
        u: mm.
        second: whether to return second derivatives.
    """
    knots = knots.detach()
    count = knots.shape[-1] - 4
    low, high = knots[3], knots[count]
    first = torch.searchsorted(knots[4:count].contiguous(), u.detach().contiguous(), right=True)
    around = first + torch.arange(1, 7, device=u.device).view(6, *[1] * u.dim())
    # The knots t_(i-2) ... t_(i+3) about the span [t_i, t_(i+1)].
    six = knots.index_select(0, around.reshape(-1)).reshape(around.shape).unbind()
    span = (*six, u, low, high)
    numbers = b_splines(*span)
    second_derivative = torch.stack(b_splines_second(*span)) if second else None
    return CubicBasis(first, torch.stack(numbers[:4]), torch.stack(numbers[4:]), second_derivative)
