"""The colour errors of a found lens, as a designer states them."""

from dataclasses import dataclass

import torch

from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.lateral_colour import lateral_colour
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order


@dataclass(frozen=True)
class LensColour:
    """Holds the colour errors of a lens over its wavelengths.

    Attributes:
        axial_um: µm, how far the paraxial focus of the longest wavelength lies behind that of the
            shortest: primary colour.
        secondary_um: µm, how far the middle of these two foci lies behind that of the reference
            wavelength: the secondary spectrum.
        lateral_um: µm, the greatest distance between chief rays of the shortest and the longest
            wavelength on the sensor, over the field.
    """

    axial_um: float
    secondary_um: float
    lateral_um: float


@torch.no_grad()
def lens_colour(lens: Lens) -> LensColour | None:
    """Return the colour errors of a lens; None for one of a single wavelength.

    Raises:
        InputError: the lens has no fields.
    """
    where = conditions(lens)
    waves = [float(w) for w in where.wavelengths]
    if min(waves) == max(waves):
        return None
    system = lens.system().double()
    lines = (min(waves), where.reference_wavelength, max(waves))
    blue, middle, red = (
        1e3 * float(first_order(system, w, where.object_distance).image) for w in lines
    )
    (scan,) = field_scans(lens, where.object_distance)
    shift = lateral_colour(lens, scan, (lines[0], lines[2]), where.object_distance).shift_um
    lateral = (shift[:, 1] - shift[:, 0]).abs().nan_to_num().amax()
    return LensColour(red - blue, 0.5 * (red + blue) - middle, float(lateral))
