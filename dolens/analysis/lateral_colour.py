"""Chromatic aberrations of chief rays and of the paraxial focus."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan, wavelength_interval
from dolens.analysis.field_curves import image_displacement
from dolens.analysis.spot_diagram import AIRY
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order


@dataclass(frozen=True)
class LateralColour:
    """Lateral colour along a scan of F fields at W wavelengths.

    Attributes:
        scan: the fields.
        wavelengths: (W,), nm.
        reference_wavelength: nm.
        shift_um: (F, W), µm on the sensor: by how much the wavelength's chief ray lands farther out
            than the reference wavelength's, in the direction of the image of the scan; NaN where
            one does not reach the sensor.
        airy_radius_um: µm, 1.22·λ·N at the reference wavelength.
    """

    scan: FieldScan
    wavelengths: Tensor
    reference_wavelength: float
    shift_um: Tensor
    airy_radius_um: float


def lateral_colour(
    lens: Lens, scan: FieldScan, wavelengths: Sequence[float] | Tensor
) -> LateralColour:
    """Compute lateral colour from real chief rays, each through the stop's centre at its own
    wavelength.

    Args:
        lens: the lens; apertures clip no chief ray.
        scan: fields on a line through the axis (see `field_scans`).
        wavelengths: (W,), nm.
    """
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    reference = lens.primary_wavelength
    every = torch.cat([waves, waves.new_tensor([reference])])
    outward = image_displacement(lens, scan, every).outward
    with torch.no_grad():
        optics = first_order(lens.system().double(), reference, scan.object_distance)
    airy = 1e-3 * AIRY * reference * abs(float(optics.working_f_number))
    shift = 1e3 * (outward[:, :-1] - outward[:, -1:])
    return LateralColour(scan, waves, reference, shift, airy)


@dataclass(frozen=True)
class FocalShift:
    """The paraxial focus at W wavelengths.

    Attributes:
        wavelengths: (W,), nm, ascending.
        reference_wavelength: nm.
        shift_um: (W,), µm along z from the focus of the reference wavelength, positive behind it;
            infinite for an afocal lens.
        depth_of_focus_um: µm, 2·λ·N² to either side of focus, within which a perfect lens of the
            same working F-number N keeps the wavefront within a quarter of a wave.
    """

    wavelengths: Tensor
    reference_wavelength: float
    shift_um: Tensor
    depth_of_focus_um: float


@torch.no_grad()
def chromatic_focal_shift(
    lens: Lens,
    interval: tuple[float, float] | None = None,
    count: int = 41,
    object_distance: float | None = None,
) -> FocalShift:
    """Compute how the paraxial focus moves with the wavelength (longitudinal colour).

    Args:
        lens: the lens.
        interval: shortest and longest wavelength, nm; None for `wavelength_interval`'s.
        count: wavelengths, with both ends.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Raises:
        InputError: fewer than two wavelengths, or an interval that does not ascend.
    """
    low, high = wavelength_interval(lens) if interval is None else interval
    if count < 2 or not 0.0 < low < high:
        raise InputError(
            f"focal shift needs two or more wavelengths from a shorter to a longer one, not "
            f"{count} from {low:g} to {high:g} nm"
        )
    system = lens.system().double()
    waves = torch.linspace(low, high, count, dtype=torch.float64)
    reference = first_order(system, lens.primary_wavelength, object_distance)
    image = torch.stack([first_order(system, float(w), object_distance).image for w in waves]).cpu()
    number = float(reference.working_f_number)
    return FocalShift(
        waves,
        lens.primary_wavelength,
        1e3 * (image - float(reference.image)),
        2e-3 * lens.primary_wavelength * number * number,
    )
