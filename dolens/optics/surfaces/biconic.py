"""A biconic has two curvatures and two conic constants, along x and along y."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.limits import GRAZING
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.clear_aperture import Outline, Rectangle
from dolens.optics.surfaces.refraction import safe_sqrt
from dolens.optics.surfaces.registry import register_surface


@register_surface
class Biconic(Surface):
    """The sag is s = (c_x·x² + c_y·y²)/(1 + √(1 - (1+k_x)·c_x²·x² - (1+k_y)·c_y²·y²)).

    Its sections along x and y are conics.  With both curvatures and both conic constants equal it
    is a conic of revolution; with one curvature zero, a cylinder whose section is a conic.  The
    surface ends where the root's argument is zero.
    """

    kind = "biconic"
    kernel = SurfaceKernel("dolens.kernels.cpu.biconic", "dolens.kernels.cuda.biconic")
    curvatures = ("curvature_x", "curvature_y")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return both curvatures and both conic constants."""
        return ["curvature_x", "curvature_y", "conic_x", "conic_y"]

    def check_aperture(self) -> None:
        """Check that the clear aperture lies within the sag's branch."""
        p = {name: value.detach() for name, value in self.named_parameters()}
        x, y = rim_points(self.aperture.edge, p["curvature_x"])
        # A whole hemisphere is allowed, and 1/R has rounded.
        rounding = 4.0 * torch.finfo(p["curvature_x"].dtype).eps
        if float(_discriminant(p, x, y).min()) < -rounding:
            raise InputError(
                f"the aperture, which reaches {self.semi_diameter:g} mm, exceeds the surface, "
                "which ends where (1+conic_x)·x²/radius_x² + (1+conic_y)·y²/radius_y² = 1"
            )

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and the root's argument as the margin.

        With W the root and e_x = (1+k_x)·c_x²: ∂s/∂x = x·(2c_x + e_x·s/W)/(1+W).  Beyond the end
        of the branch the surface goes on as the paraboloid c_x·x² + c_y·y², from where Newton's
        iteration finds back.
        """
        cx, cy = p["curvature_x"], p["curvature_y"]
        discriminant = _discriminant(p, x, y)
        root = safe_sqrt(discriminant)
        inverse = 1.0 / (1.0 + root)
        sag = torch.addcmul(cx * x * x, cy * y, y) * inverse
        steep = torch.where(root > GRAZING, sag / root, 0.0)
        sx = x * (2.0 * cx + (1.0 + p["conic_x"]) * cx * cx * steep) * inverse
        sy = y * (2.0 * cy + (1.0 + p["conic_y"]) * cy * cy * steep) * inverse
        return sag, sx, sy, discriminant.detach()

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


def _discriminant(p: Parameters, x: Tensor, y: Tensor) -> Tensor:
    cx, cy = p["curvature_x"], p["curvature_y"]
    ex, ey = (1.0 + p["conic_x"]) * cx * cx, (1.0 + p["conic_y"]) * cy * cy
    return 1.0 - torch.addcmul(ex * x * x, ey * y, y)
