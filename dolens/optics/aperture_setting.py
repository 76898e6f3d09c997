"""A lens is looked at with its stop opened or closed to a given aperture."""

import copy
import math

import torch

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.surfaces.clear_aperture import Circle


@torch.no_grad()
def with_aperture(
    lens: Lens, f_number: float | None = None, entrance_pupil_diameter: float | None = None
) -> Lens:
    """Return a copy of a lens whose stop makes a given pupil; the lens itself where none is given.

    The stop's semi-diameter becomes the one whose paraxial image has the diameter asked for at the
    reference wavelength.  Other apertures stay as they are, and may clip what a wider stop passes.

    Args:
        lens: the lens.
        f_number: EFL over the diameter of the entrance pupil, both of the y-z section; or
        entrance_pupil_diameter: mm.

    Raises:
        InputError: both are given, one is not positive, the stop is no circle, or no stop on its
            surface makes this pupil.
    """
    either = {"f_number": f_number, "entrance_pupil_diameter": entrance_pupil_diameter}
    given = {name: value for name, value in either.items() if value is not None}
    if not given:
        return lens
    if len(given) > 1:
        raise InputError("give f_number or entrance_pupil_diameter, not both")
    ((name, target),) = given.items()
    if not (target > 0.0 and math.isfinite(target)):
        raise InputError(f"{name} must be positive, not {target}")
    lens = copy.deepcopy(lens)
    exact = copy.deepcopy(lens).to(torch.float64)
    first = exact.first_order(lens.primary_wavelength, meridian="y")
    diameter = abs(float(first.efl)) / target if name == "f_number" else target
    surface = lens.surfaces[str(lens.stop)]
    if not isinstance(surface.aperture.edge, Circle):
        raise InputError(f"{name} needs a circular stop; surface {lens.stop} has another edge")
    size = surface.semi_diameter * diameter / float(first.entrance_pupil.diameter)
    if not (math.isfinite(size) and size > 0.0):
        raise InputError(f"{name} {target:g}: no size of the stop makes this pupil")
    try:
        lens.stop_note = ""
        surface.aperture = surface.aperture.resized(size)
        surface.check_aperture()
    except InputError as error:
        raise InputError(f"{name} {target:g}: stop surface {lens.stop}: {error}") from None
    return lens
