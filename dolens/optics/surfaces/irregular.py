"""An irregular surface is an even asphere that was made out of round."""

from torch import Tensor

from dolens.optics.surfaces.asphere_with_terms import even_asphere
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.by_names import by_names
from dolens.optics.surfaces.even_asphere import EvenAsphere
from dolens.optics.surfaces.zernike import ZernikeFringe

# The terms ρ²·cos 2φ and ρ²·sin 2φ.
ASTIGMATIC = ("z5", "z6")


class Irregular(ZernikeFringe):
    """The sag is that of an even asphere plus (z5·(x² - y²) + 2·z6·x·y)/normalization_radius².

    It is a `ZernikeFringe` of these two terms about the vertex, for which more is known in closed
    form: averaged over azimuth they are zero.  No prescription has it; see
    `dolens.optics.departures`.
    """

    kernel = ZernikeFringe.kernel

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the two terms and their slopes."""
        square = p["normalization_radius"].square()
        a, b = (p[name] / square for name in ASTIGMATIC)
        slope_x, slope_y = 2.0 * (a * x + b * y), 2.0 * (b * x - a * y)
        return 0.5 * (x * slope_x + y * slope_y), slope_x, slope_y

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return that of the even asphere."""
        return EvenAsphere.paraxial_curvature(even_asphere(p))

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return that of the even asphere."""
        return EvenAsphere.fourth_order_departure(even_asphere(p))

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return what `ZernikeFringe` does."""
        return super().packed(p)
