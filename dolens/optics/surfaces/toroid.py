"""A toroid is a curve in the y-z plane that is rotated about an axis parallel to y."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operations import (
    Number,
    divide,
    fma,
    length,
    put,
    safe_sqrt,
    where,
    zero,
)
from dolens.kernels.shapes import Shape
from dolens.kernels.table import GRAZING, TINY
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.even_asphere import (
    EVEN_ASPHERE,
    EvenAsphere,
    even_asphere_hessian,
    even_asphere_parameters,
    even_asphere_sag,
    even_power,
)
from dolens.optics.surfaces.registry import register_surface


def _section(f: Number, c: Number, x: Number) -> tuple[Number, Number, Number, Number]:
    """Return g, which is held, W², W, and 1 - c·f, of the circle through a point f of the curve."""
    towards = 1.0 - c * f
    g = where(towards > GRAZING, towards, GRAZING)
    squared = g * g - (c * x) * (c * x)
    return g, squared, safe_sqrt(squared), towards


def toroid_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag, slopes, and a margin that is positive where the curve and the circle exist.

    With W = √(g² - c²·x²) = 1 - c·s: ∂s/∂x = c·x/W and ∂s/∂y = f'·g/W.  Beyond the circle's end the
    surface goes on as f + c·x²/g.
    """
    curvature, k, a2, a, c = p
    f, _, slope, margin = even_asphere_sag((curvature, k, a2, a), zero(y), y)
    g, squared, root, towards = _section(f, c, x)
    on = squared > TINY
    inverse = divide(1.0, where(on, root, g))
    bent = c * x * inverse
    sx = where(on, bent, 2.0 * bent)
    sy = slope * where(on, g * inverse, fma(bent, bent, 1.0))
    margin = where(squared < margin, squared, margin)
    margin = where(towards < margin, towards, margin)
    return fma(c * x, divide(x, g + root), f), sx, sy, margin


def toroid_hessian(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives.

    W·s_xx = c + c·s_x², W·s_xy = c·s_x·s_y and W·s_yy = g·f'' + c·(s_y² - f'²).
    """
    curvature, k, a2, a, c = p
    f, _, slope, _ = even_asphere_sag((curvature, k, a2, a), zero(y), y)
    _, _, _, _, second = even_asphere_hessian((curvature, k, a2, a), zero(y), y)
    g, _, root, _ = _section(f, c, x)
    inverse = divide(1.0, root)
    sx, sy = c * x * inverse, slope * g * inverse
    return (
        sx,
        sy,
        c * (1.0 + sx * sx) * inverse,
        c * sx * sy * inverse,
        (g * second + c * (sy * sy - slope * slope)) * inverse,
    )


def toroid_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of the curve's numbers and of c.

    Of c: W·s_c = (s² + x² - f²)/2.  Of the curve's numbers: s_θ = (g/W)·f_θ, so the curve's own
    function takes the cotangents times g/W, and what the slopes of g/W add.
    """
    curvature, k, a2, a, c = p
    f, _, slope, _ = even_asphere_sag((curvature, k, a2, a), zero(y), y)
    g, _, root, _ = _section(f, c, x)
    inverse = divide(1.0, root)
    ratio = g * inverse
    s = f + divide(c * x * x, g + root)
    along = of_x * (c * x * inverse) + of_y * (slope * ratio)
    # (s² - f²)/2 without cancellation.
    lever = 0.5 * ((s - f) * (s + f) + x * x)
    of_lever = s * along + x * of_x - f * slope * of_y
    of_c = inverse * (of_sag * lever + of_lever + c * lever * along * inverse)
    put(cotangents, 3 + length(a), of_c)
    of_f = of_sag * ratio + c * (ratio * along - slope * of_y) * inverse
    even_asphere_parameters(
        cotangents, (curvature, k, a2, a), zero(y), y, of_f, zero(y), ratio * of_y
    )


TOROID = Shape(
    "toroid",
    toroid_sag,
    toroid_hessian,
    toroid_parameters,
    layout=(*EVEN_ASPHERE.layout, None),
)


@register_surface
class Toroid(Surface):
    """The curve f(y) = conic(c_y, k_y; y) + a2·y² + a4·y⁴ + ... goes round at the distance 1/c_x.

    The axis of rotation is parallel to y and crosses the z axis at z = 1/c_x.  With g = 1 - c_x·f
    the sag is s = f + c_x·x²/(g + √(g² - c_x²·x²)).  c_x = 0, an infinite radius of rotation, is a
    cylinder along x.  The surface ends where the curve does, and where the circle about the axis
    turns back, g² = c_x²·x².
    """

    kind = "toroid"
    shape = TOROID
    curvatures = ("curvature_x", "curvature_y")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the curve's curvature, conic constant and even powers, and c_x."""
        _, _, *powers = EvenAsphere.parameter_names(keys)
        return ["curvature_x", "curvature_y", "conic_y", *powers]

    def check_aperture(self) -> None:
        """Check that the clear aperture lies within the sag's branch."""
        p = {name: value.detach() for name, value in self.named_parameters(recurse=False)}
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
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return the curve's numbers as an even asphere's, and then c_x."""
        return *EvenAsphere.numbers(_curve(p)), p["curvature_x"]

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return (c_x + c_y)/2 + a2: the mean over azimuth."""
        return 0.5 * (p["curvature_x"] + EvenAsphere.paraxial_curvature(_curve(p)))


def _curve(p: Parameters) -> dict[str, Tensor]:
    """Return the parameters of the even asphere whose section along y is the curve."""
    even = {name: value for name, value in p.items() if even_power(name) is not None}
    return {"curvature": p["curvature_y"], "conic": p["conic_y"], **even}
