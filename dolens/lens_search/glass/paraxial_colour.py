"""Colour errors of many lenses from their paraxial rays at each wavelength.

They are the exact differences of first-order optics, not the primary sums: no wavelength is near
another.  Numbers are tensors (L,), or `Tangents` that carry derivatives with respect to curvatures,
gaps and the coordinates of glasses; lengths are in units of the focal length that is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.paraxial import LensNumbers, Paraxial, paraxial
from dolens.optics.paraxial_recurrence import Number


@dataclass(frozen=True)
class ParaxialColour:
    """Colour errors on the sensor of L lenses.

    Attributes:
        axial: of each wavelength, the height on the sensor of the marginal ray that enters at
            height 1: its radius of blur over that of the entrance pupil.
        lateral: of each wavelength, the height of the chief ray that enters with slope 1 less that
            of the reference wavelength.
        focus: of each wavelength, from the last surface.
    """

    axial: Sequence[Number]
    lateral: Sequence[Number]
    focus: Sequence[Number]

    def secondary_spectrum(self, short: int, middle: int, long: int) -> Number:
        """Return how far the mean focus of two wavelengths lies behind that of a third one."""
        return 0.5 * (self.focus[short] + self.focus[long]) - self.focus[middle]

    def primary_colour(self, short: int, long: int) -> Number:
        """Return how far the focus of the long wavelength lies behind that of the short one."""
        return self.focus[long] - self.focus[short]


def paraxial_colour(
    arrangement: Arrangement, lenses: Sequence[LensNumbers], reference: int
) -> ParaxialColour:
    """Return the colour errors of L lenses.

    Args:
        arrangement: the order.
        lenses: the same ones with their indices at each wavelength.
        reference: number of the wavelength that heights are compared with.
    """
    rays = [paraxial(arrangement, numbers) for numbers in lenses]
    image = lenses[reference].image
    heights = [_chief_height(ray, image) for ray in rays]
    return ParaxialColour(
        axial=[ray.power * (ray.back_focus - image) for ray in rays],
        lateral=[height - heights[reference] for height in heights],
        focus=[ray.back_focus for ray in rays],
    )


def _chief_height(ray: Paraxial, image: Number) -> Number:
    """Return where the chief ray of slope 1 meets a plane behind the last surface.

    It goes from its height on that surface to the height 1/power in the focal plane, as all rays of
    its slope do; the back focus times the power is the marginal ray's height on that surface.
    """
    last = ray.chief[-1]
    return last * (1.0 - image / ray.back_focus) + image / ray.marginal[-1]
