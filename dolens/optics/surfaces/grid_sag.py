"""A surface is given by its sag on a regular grid, on top of an even asphere.

Between the nodes the sag is bicubic (Hermite's form), from values and slopes at the nodes.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.cubics import hermite
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.splines import spline_slopes
from dolens.optics.surfaces.base import PackedShape, Parameters, tensor_of
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.even_asphere import AsphereWithTerms, EvenAsphere, even_asphere
from dolens.optics.surfaces.registry import register_surface

_ARRAYS = ("sag", "slope_x", "slope_y", "twist")
# The slopes of splines through so many nodes are found in a second.
_MOST_NODES = 2000
_LENGTHS = ("spacing_x", "spacing_y", "decenter_x", "decenter_y")


@register_surface
class GridSag(AsphereWithTerms):
    """The sag is that of an even asphere plus a bicubic interpolation of the array `sag` (mm).

    Rows lie along y and columns along x, both rising, `spacing_y` and `spacing_x` mm apart; the
    grid's middle is at (decenter_x, decenter_y).  `slope_x`, `slope_y` and `twist` (∂²/∂x∂y, 1/mm)
    at the nodes may be given.  What is missing comes from cubic splines through the rows and
    columns, so that the surface has continuous second derivatives.

    The grid is data: no optimizer varies it.  It must hold the clear aperture, and a ray that meets
    the surface beyond it misses; there the surface goes on along its tangents.
    """

    kind = "grid_sag"
    kernel = SurfaceKernel("dolens.kernels.cpu.grid_sag", "dolens.kernels.cuda.grid_sag")
    constants = (*_LENGTHS, *_ARRAYS)
    arrays = _ARRAYS
    optional = ("slope_x", "slope_y", "twist")

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(aperture, with_slopes(parameters), dtype)

    def check_aperture(self) -> None:
        """Check that the clear aperture lies within the conic and within the grid."""
        super().check_aperture()
        p = dict(self.named_buffers())
        for axis, reach, half in zip("xy", self.aperture.edge.extent, half_sizes(p), strict=True):
            off = abs(float(p[f"decenter_{axis}"]))
            if reach + off > float(half):
                raise InputError(
                    f"the aperture reaches {reach + off:g} mm from the middle of 'sag' along "
                    f"{axis}, and the grid only {float(half):g} mm"
                )

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the grid and its spacings."""
        return list(cls.constants)

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and a margin that is positive on the conic and on the grid."""
        sag, sx, sy, exists = EvenAsphere.sag_and_gradient(even_asphere(p), x, y)
        added, ax, ay = cls.added_terms(p, x, y)
        half_x, half_y = half_sizes(p)
        inside = torch.minimum(
            half_x - (x - p["decenter_x"]).detach().abs(),
            half_y - (y - p["decenter_y"]).detach().abs(),
        )
        inside = inside if exists is None else torch.minimum(exists, inside)
        return sag + added, sx + ax, sy + ay, inside

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the grid's sag and slopes."""
        nodes = torch.stack([p[name] for name in _ARRAYS], -1)
        spacing = (p["spacing_x"], p["spacing_y"])
        return bicubic(nodes, spacing, x - p["decenter_x"], y - p["decenter_y"])

    @classmethod
    def packed(cls, p: Parameters) -> PackedShape:
        """Return the even asphere's numbers, and spacings, decentre, and the nodes' four numbers
        each, by rows, which are data.

        Columns and degree: how many columns and rows.
        """
        nodes = torch.stack([p[name] for name in _ARRAYS], -1)
        rows, columns = p["sag"].shape
        own = (*(p[name] for name in _LENGTHS), nodes)
        even = EvenAsphere.packed(even_asphere(p))
        return even._replace(
            numbers=(*even.numbers, *own), columns=columns, degree=rows, data=4 + nodes.numel()
        )


def half_sizes(p: Parameters) -> tuple[Tensor, Tensor]:
    """Return how far the grid reaches from its middle along x and y, mm."""
    rows, columns = p["sag"].shape
    return 0.5 * (columns - 1) * p["spacing_x"], 0.5 * (rows - 1) * p["spacing_y"]


def with_slopes(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters with the slopes and twists that were not given.

    Raises:
        InputError: a grid that is no matrix of at least 2 × 2, arrays of other shapes, or spacings
            that are not positive.
    """
    given = dict.fromkeys(("decenter_x", "decenter_y"), 0.0) | dict(parameters)
    arrays = {
        name: tensor_of(given[name], name, torch.float64) for name in _ARRAYS if name in given
    }
    sag = arrays.get("sag")
    if sag is None or sag.dim() != 2 or min(sag.shape) < 2:
        raise InputError("'sag' must be at least 2 rows (y) of at least 2 numbers (x), mm")
    if max(sag.shape) > _MOST_NODES:
        raise InputError(
            f"'sag' has {sag.shape[0]} rows of {sag.shape[1]} numbers (allowed: {_MOST_NODES} each)"
        )
    for name, array in arrays.items():
        if array.shape != sag.shape:
            raise InputError(
                f"'{name}' must have as many rows and columns as 'sag', {sag.shape[0]} × "
                f"{sag.shape[1]}"
            )
    spacing = [float(given.get(name, 0.0)) for name in _LENGTHS[:2]]
    if not min(spacing) > 0.0:
        raise InputError("'spacing_x' and 'spacing_y' must be given and positive (mm)")
    values = sag.numpy()

    def along_y(array: np.ndarray) -> np.ndarray:
        return spline_slopes(array.T, spacing[1] * np.arange(len(array))).T

    if "slope_x" not in arrays:
        given["slope_x"] = spline_slopes(values, spacing[0] * np.arange(values.shape[1]))
    if "slope_y" not in arrays:
        given["slope_y"] = along_y(values)
    if "twist" not in arrays:
        given["twist"] = along_y(np.asarray(given["slope_x"], dtype=np.float64))
    return given


class Cell(NamedTuple):
    """Basis functions of Hermite's cubics along one axis, and the cell of each point.

    Attributes:
        first: index of the cell's lower node, int64.
        value: weights of value and slope at the lower node, then at the upper one; four tensors.
        slope: their derivatives, 1/mm.
    """

    first: Tensor
    value: tuple[Tensor, ...]
    slope: tuple[Tensor, ...]


def cell_of(u: Tensor, spacing: Tensor, count: int) -> Cell:
    """Return the cell of points along one axis, and the basis there.

    Args:
        u: mm, from the middle of the grid.
        spacing: mm.
        count: nodes.
    """
    place = u / spacing + 0.5 * (count - 1)
    first = place.detach().floor().clamp(0, count - 2)
    first = torch.where(first == first, first, torch.zeros_like(first))
    # Beyond the grid the outermost cell goes on straight: along its tangent at the edge.
    numbers = hermite(place - first, spacing)
    return Cell(first.long(), numbers[:4], numbers[4:])


def bicubic(
    nodes: Tensor, spacing: tuple[Tensor, Tensor], x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the interpolated value and its slopes along x and y.

    Args:
        nodes: (rows, columns, 4): value (mm), slopes along x and y, and ∂²/∂x∂y (1/mm); rows along
            y.
        spacing: of columns and of rows, mm.
        x: mm, from the middle of the grid.
        y: mm.
    """
    x, y = torch.broadcast_tensors(x, y)
    rows, columns = nodes.shape[0], nodes.shape[1]
    along, across = cell_of(x, spacing[0], columns), cell_of(y, spacing[1], rows)
    total, sx, sy = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    flat = nodes.reshape(-1, 4)
    for j in range(2):
        for i in range(2):
            index = (across.first + j) * columns + along.first + i
            node = flat.index_select(0, index.reshape(-1)).reshape(*index.shape, 4)
            for k in range(4):
                a, b = 2 * i + k % 2, 2 * j + k // 2
                c = node[..., k]
                total = total + c * along.value[a] * across.value[b]
                sx = sx + c * along.slope[a] * across.value[b]
                sy = sy + c * along.value[a] * across.slope[b]
    return total, sx, sy
