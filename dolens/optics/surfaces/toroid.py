"""A toroid is a curve in the y-z plane that is rotated about an axis parallel to y."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.limits import GRAZING
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
from dolens.optics.surfaces.even_asphere import EvenAsphere, even_power
from dolens.optics.surfaces.refraction import safe_sqrt
from dolens.optics.surfaces.registry import register_surface


@register_surface
class Toroid(Surface):
    """The curve f(y) = conic(c_y, k_y; y) + a2·y² + a4·y⁴ + ... goes round at the distance 1/c_x.

    The axis of rotation is parallel to y and crosses the z axis at z = 1/c_x.  With g = 1 - c_x·f
    the sag is s = f + c_x·x²/(g + √(g² - c_x²·x²)).  c_x = 0, an infinite radius of rotation, is a
    cylinder along x.  The surface ends where the curve does, and where the circle about the axis
    turns back, g² = c_x²·x².
    """

    kind = "toroid"
    kernel = SurfaceKernel("dolens.kernels.cpu.toroid", "dolens.kernels.cuda.toroid")
    curvatures = ("curvature_x", "curvature_y")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the curve's curvature, conic constant and even powers, and c_x."""
        _, _, *powers = EvenAsphere.parameter_names(keys)
        return ["curvature_x", "curvature_y", "conic_y", *powers]

    def check_aperture(self) -> None:
        """Check that the clear aperture lies within the sag's branch."""
        p = {name: value.detach() for name, value in self.named_parameters()}
        rounding = 4.0 * torch.finfo(p["curvature_x"].dtype).eps
        share = torch.linspace(0.0, 1.0, 65).to(p["curvature_x"])
        x, y = (reach * share for reach in self.aperture.edge.extent)
        for along_x, along_y in ((x, torch.zeros_like(y)), (torch.zeros_like(x), y)):
            exists = self.sag_and_gradient(p, along_x, along_y)[3]
            if exists is not None and float(exists.min()) < -rounding:
                raise InputError(
                    f"the aperture, which reaches {self.semi_diameter:g} mm, exceeds the surface, "
                    "which ends where its curve in y does, or at the radius of rotation in x"
                )

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes; the margin is positive where the curve and the circle exist.

        With W = √(g² - c_x²·x²) = 1 - c_x·s: ∂s/∂x = c_x·x/W and ∂s/∂y = f'·g/W.  Beyond the
        circle's end the surface goes on as f + c_x·x²/g.
        """
        cx = p["curvature_x"]
        f, _, df, exists = EvenAsphere.sag_and_gradient(_curve(p), torch.zeros_like(y), y)
        g = (1.0 - cx * f).clamp(min=GRAZING)
        squared = torch.addcmul(g * g, cx * x, cx * x, value=-1.0)
        root = safe_sqrt(squared)
        on = root > GRAZING
        inverse = 1.0 / torch.where(on, root, g)
        sag = torch.addcmul(f, cx * x, x / (g + root))
        bent = cx * x * inverse
        sx = torch.where(on, bent, 2.0 * bent)
        across = torch.where(on, g * inverse, 1.0 + bent * bent)
        margin = squared.detach() if exists is None else torch.minimum(exists, squared.detach())
        return sag, sx, df * across, torch.minimum(margin, (1.0 - cx * f).detach())

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return the curve's numbers as an even asphere's, and then c_x."""
        even = EvenAsphere.packed(_curve(p))
        return even._replace(numbers=(*even.numbers, p["curvature_x"]))

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return (c_x + c_y)/2 + a2: the mean over azimuth."""
        return 0.5 * (p["curvature_x"] + EvenAsphere.paraxial_curvature(_curve(p)))


def _curve(p: Parameters) -> dict[str, Tensor]:
    """Return the parameters of the even asphere whose section along y is the curve."""
    even = {name: value for name, value in p.items() if even_power(name) is not None}
    return {"curvature": p["curvature_y"], "conic": p["conic_y"], **even}
