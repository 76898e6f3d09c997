"""A lens is prepared for its page: with other fields, wavelengths or aperture than its own."""

import copy
import math
from collections.abc import Sequence

import torch

from dolens.analysis.conditions import field_points
from dolens.analysis.fields_and_wavelengths import as_wavelengths, spectral_shares
from dolens.errors import InputError
from dolens.optics.aperture_setting import with_aperture
from dolens.optics.fields import Fields
from dolens.optics.lens import Lens


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
        wavelengths: nm; they count alike unless they are the lens's own.  The reference wavelength
            stays if it is one of them, and else is the middle one in their order.
        f_number: focal length over the diameter of the entrance pupil, which the stop is set to.
        entrance_pupil_diameter: mm, instead of an F-number.

    Raises:
        InputError: a field, wavelength or aperture out of range, or two apertures.
    """
    lens = copy.deepcopy(lens).to(device="cpu", dtype=torch.float64).requires_grad_(False)
    if wavelengths is not None:
        waves = as_wavelengths(wavelengths).tolist()
        if len(set(waves)) < len(waves):
            raise InputError(f"wavelengths: one is given twice, {waves}")
        # Its own wavelengths keep their weights; others count alike.
        shares = spectral_shares(lens, waves)
        weighted = lens.wavelength_weights is not None
        lens.wavelength_weights = tuple(shares.tolist()) if weighted else None
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
    return with_aperture(lens, f_number, entrance_pupil_diameter)
