"""A lens is prepared for its page: with the fields, wavelengths and aperture that were asked for."""

import copy
import math
from collections.abc import Sequence

import torch

from dolens.analysis.conditions import field_points
from dolens.errors import InputError
from dolens.optics.fields import Fields
from dolens.optics.lens import Lens
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture


def prepared_lens(
    lens: Lens,
    fields: Sequence[Sequence[float]] | None = None,
    wavelengths: Sequence[float] | None = None,
    f_number: float | None = None,
    entrance_pupil_diameter: float | None = None,
) -> Lens:
    """Return a copy of a lens, in double precision, with other fields, wavelengths or aperture.

    Args:
        lens: stays as it is.
        fields: (x, y) of each: degrees for an object at infinity, else mm on the object.
        wavelengths: nm; the reference wavelength stays if it is one of them, and else is the middle
            one in their order.
        f_number: focal length over the diameter of the entrance pupil, which the stop is closed to.
        entrance_pupil_diameter: mm, instead of an F-number.

    Raises:
        InputError: a field, wavelength or aperture out of range, two apertures, or one that the
            stop's clear aperture is too small for.
    """
    lens = copy.deepcopy(lens).to(device="cpu", dtype=torch.float64).requires_grad_(False)
    if wavelengths is not None:
        waves = [float(wave) for wave in wavelengths]
        if not waves or not all(math.isfinite(wave) and wave > 0.0 for wave in waves):
            raise InputError(f"wavelengths must be positive numbers in nm, not {waves}")
        if len(set(waves)) < len(waves):
            raise InputError(f"wavelengths: one is given twice, {waves}")
        lens.wavelengths = tuple(waves)
        if lens.reference_wavelength not in waves:
            lens.reference_wavelength = waves[(len(waves) - 1) // 2]
    if fields is not None:
        points = field_points(fields)
        finite = lens.object_distance is not None and math.isfinite(lens.object_distance)
        if not finite and not bool((points.abs() < 90.0).all()):
            raise InputError(f"fields must be within ±90 degrees, not {points.tolist()}")
        kind = "heights" if finite else "angles"
        lens.fields = Fields(kind, tuple((x, y) for x, y in points.tolist()))
    if f_number is not None and entrance_pupil_diameter is not None:
        raise InputError("give an F-number or the diameter of the entrance pupil, not both")
    if f_number is not None:
        _close_stop(lens, "F-number", f_number)
    if entrance_pupil_diameter is not None:
        _close_stop(lens, "entrance pupil diameter", entrance_pupil_diameter)
    return lens


def _close_stop(lens: Lens, what: str, value: float) -> None:
    """Close the stop to an aperture; the paraxial pupil is proportional to the stop's size."""
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"the {what} must be positive, not {value:g}")
    first = lens.first_order(lens.primary_wavelength)
    diameter, efl = float(first.entrance_pupil.diameter), abs(float(first.efl))
    if what == "F-number" and not math.isfinite(efl):
        raise InputError("an F-number needs a focal length, and the lens is afocal")
    surface = lens.surfaces[str(lens.stop)]
    aperture = surface.aperture
    if not isinstance(aperture.edge, Circle):
        raise InputError(f"surface {lens.stop}, the stop, is no circle: no {what} can be set")
    size = surface.semi_diameter * (efl / value if what == "F-number" else value) / diameter
    if not size <= surface.semi_diameter * (1.0 + 1e-9):
        widest = efl / diameter if what == "F-number" else diameter
        bound = "at least" if what == "F-number" else "at most"
        raise InputError(
            f"the {what} must be {bound} {widest:.4g}{'' if what == 'F-number' else ' mm'}, not "
            f"{value:g}: surface {lens.stop}, the stop, is no larger"
        )
    surface.aperture = ClearAperture(
        Circle(min(size, surface.semi_diameter)), aperture.obscuration
    )
