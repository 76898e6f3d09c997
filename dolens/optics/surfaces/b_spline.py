"""A freeform surface may be a cubic B-spline (S7, S8)."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError, check_keys
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, tensor_of
from dolens.optics.surfaces.by_names import by_names
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.registry import register_surface
from dolens.optics.surfaces.spline_basis import check_knots, clamped_knots, cubic_basis


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
