"""A biconic has two curvatures and two conic constants, along x and along y."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operations import Number, divide, fma, put, safe_sqrt, where
from dolens.kernels.shapes import Shape
from dolens.kernels.table import TINY
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.clear_aperture import Outline, Rectangle
from dolens.optics.surfaces.registry import register_surface


def _roots(
    cx: Number, cy: Number, ex: Number, ey: Number, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return W², 1/W and 1/(1+W), the sag and its slopes.

    With W = √(1 - e_x·x² - e_y·y²): ∂s/∂x = x·(2c_x + e_x·s/W)/(1+W).  Beyond the end of the branch
    1/W is zero, and the surface goes on as the paraboloid c_x·x² + c_y·y², from where Newton's
    iteration finds back.
    """
    squared = 1.0 - fma(ex * x, x, ey * y * y)
    root = safe_sqrt(squared)
    g = where(squared > TINY, divide(1.0, root), 0.0)
    u = divide(1.0, 1.0 + root)
    s = fma(cx * x, x, cy * y * y) * u
    steep = s * g
    sx, sy = x * fma(ex, steep, 2.0 * cx) * u, y * fma(ey, steep, 2.0 * cy) * u
    return squared, g, u, s, sx, sy


def biconic_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag, slopes, and W², which is positive on the branch."""
    cx, cy, kx, ky = p
    squared, _, _, s, sx, sy = _roots(cx, cy, (1.0 + kx) * cx * cx, (1.0 + ky) * cy * cy, x, y)
    return s, sx, sy, squared


def biconic_hessian(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives, from s·(1+W) = c_x·x² + c_y·y²: s_xx·(1+W) + 2s_x·W_x +
    s·W_xx = 2c_x.
    """
    cx, cy, kx, ky = p
    ex, ey = (1.0 + kx) * cx * cx, (1.0 + ky) * cy * cy
    _, g, u, s, sx, sy = _roots(cx, cy, ex, ey, x, y)
    wx, wy = -ex * x * g, -ey * y * g
    return (
        sx,
        sy,
        (2.0 * cx - 2.0 * sx * wx + s * (ex * g + wx * wx * g)) * u,
        (s * wx * wy * g - sx * wy - sy * wx) * u,
        (2.0 * cy - 2.0 * sy * wy + s * (ey * g + wy * wy * g)) * u,
    )


def biconic_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of c_x, c_y, k_x and k_y.

    With u = 1/(1+W): ∂s/∂c_x at fixed e is x²·u, and ∂s/∂e_x is x²·m with m = s·u/(2W).  Their
    slopes come from those of u and m along (of_x, of_y).
    """
    cx, cy, kx, ky = p
    ex, ey = (1.0 + kx) * cx * cx, (1.0 + ky) * cy * cy
    _, g, u, s, sx, sy = _roots(cx, cy, ex, ey, x, y)
    of_root = -(of_x * ex * x + of_y * ey * y) * g
    m = 0.5 * s * g * u
    du = -u * u * of_root
    dm = 0.5 * u * g * (of_x * sx + of_y * sy - s * of_root * (u + g))
    ax, ay = x * (of_sag * x + 2.0 * of_x), y * (of_sag * y + 2.0 * of_y)
    of_ex, of_ey = ax * m + x * x * dm, ay * m + y * y * dm
    put(cotangents, 0, ax * u + x * x * du + 2.0 * (1.0 + kx) * cx * of_ex)
    put(cotangents, 1, ay * u + y * y * du + 2.0 * (1.0 + ky) * cy * of_ey)
    put(cotangents, 2, cx * cx * of_ex)
    put(cotangents, 3, cy * cy * of_ey)


BICONIC = Shape("biconic", biconic_sag, biconic_hessian, biconic_parameters, layout=(None,) * 4)


@register_surface
class Biconic(Surface):
    """The sag is s = (c_x·x² + c_y·y²)/(1 + √(1 - (1+k_x)·c_x²·x² - (1+k_y)·c_y²·y²)).

    Its sections along x and y are conics.  With both curvatures and both conic constants equal it
    is a conic of revolution; with one curvature zero, a cylinder whose section is a conic.  The
    surface ends where the root's argument is zero.
    """

    kind = "biconic"
    shape = BICONIC
    curvatures = ("curvature_x", "curvature_y")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return both curvatures and both conic constants."""
        return ["curvature_x", "curvature_y", "conic_x", "conic_y"]

    def check_aperture(self) -> None:
        """Check that the clear aperture lies within the sag's branch."""
        p = {name: value.detach() for name, value in self.named_parameters(recurse=False)}
        x, y = rim_points(self.aperture.edge, p["curvature_x"])
        # A whole hemisphere is allowed, and 1/R has rounded.
        rounding = 4.0 * torch.finfo(p["curvature_x"].dtype).eps
        if float(biconic_sag(self.numbers(p), x, y)[3].min()) < -rounding:
            raise InputError(
                f"the aperture, which reaches {self.semi_diameter:g} mm, exceeds the surface, "
                "which ends where (1+conic_x)·x²/radius_x² + (1+conic_y)·y²/radius_y² = 1"
            )

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return c_x, c_y, k_x and k_y."""
        return p["curvature_x"], p["curvature_y"], p["conic_x"], p["conic_y"]

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return (c_x + c_y)/2: the mean over azimuth."""
        return 0.5 * (p["curvature_x"] + p["curvature_y"])


def rim_points(edge: Outline, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (mm) of an aperture's edge: where it cuts the axes, and a rectangle's corner.

    A form e_x·x² + e_y·y² is largest over the aperture at one of them, or at the vertex.
    """
    x, y = edge.extent
    points = [(x, 0.0), (0.0, y)] + ([(x, y)] if isinstance(edge, Rectangle) else [])
    rim = torch.tensor(points, dtype=like.dtype, device=like.device)
    return rim[:, 0], rim[:, 1]
