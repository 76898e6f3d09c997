"""First-order data of a lens as plain numbers, and as rows of a table."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from dolens.analysis.spot_diagram import AIRY
from dolens.optics.lens import Lens


class Quantity(NamedTuple):
    """One row of a table of numbers.

    Attributes:
        name: of the quantity.
        value: infinite where it lies at infinity.
        unit: with the reference point of a distance, as `mm from the first vertex`; may be empty.
        digits: significant digits that are shown.
    """

    name: str
    value: float
    unit: str
    digits: int = 6


@dataclass(frozen=True)
class FirstOrderNumbers:
    """First-order data of a lens at its reference wavelength; lengths in mm, z from the first
    vertex.

    Infinite values are `inf`: the EFL of an afocal lens, the pupil of a telecentric one.

    Attributes:
        reference_wavelength: nm.
        object_distance: in front of the first vertex; `inf` for infinity.
        efl: effective focal length.
        bfd: back focal distance, last vertex to rear focus.
        ffd: front focal distance, first vertex to front focus.
        f_number: EFL over the entrance pupil's diameter.
        working_f_number: 1/(2·n'·|u'|) of the paraxial marginal ray at the image.
        entrance_pupil_z: where the stop is seen from the object.
        entrance_pupil_diameter: of that image of the stop.
        exit_pupil_z: where the stop is seen from the sensor.
        exit_pupil_diameter: of that image of the stop.
        front_principal_z: of the front principal plane.
        rear_principal_z: of the rear principal plane.
        magnification: paraxial, zero for an object at infinity.
        paraxial_image_z: of the axial object point.
        defocus: from the paraxial image to the sensor.
        length: first to last vertex.
        total_track: first vertex to sensor.
        airy_radius_um: µm, 1.22·λ·N with the working F-number.
    """

    reference_wavelength: float
    object_distance: float
    efl: float
    bfd: float
    ffd: float
    f_number: float
    working_f_number: float
    entrance_pupil_z: float
    entrance_pupil_diameter: float
    exit_pupil_z: float
    exit_pupil_diameter: float
    front_principal_z: float
    rear_principal_z: float
    magnification: float
    paraxial_image_z: float
    defocus: float
    length: float
    total_track: float
    airy_radius_um: float

    def quantities(self) -> list[Quantity]:
        """Return the rows of a table; those of a near object only where there is one."""
        near = [
            Quantity("working F-number", self.working_f_number, ""),
            Quantity("magnification", self.magnification, ""),
            Quantity("object distance", self.object_distance, "mm in front of the first vertex"),
        ]
        from_first = "mm from the first vertex"
        return [
            Quantity("effective focal length", self.efl, "mm"),
            Quantity("back focal distance", self.bfd, "mm behind the last vertex"),
            Quantity("front focal distance", self.ffd, from_first),
            Quantity("F-number", self.f_number, "focal length over entrance pupil"),
            *(near if math.isfinite(self.object_distance) else ()),
            Quantity("entrance pupil diameter", self.entrance_pupil_diameter, "mm"),
            Quantity("entrance pupil position", self.entrance_pupil_z, from_first),
            Quantity("exit pupil diameter", self.exit_pupil_diameter, "mm"),
            Quantity("exit pupil position", self.exit_pupil_z, from_first),
            Quantity("front principal plane", self.front_principal_z, from_first),
            Quantity("rear principal plane", self.rear_principal_z, from_first),
            Quantity("paraxial image", 0.0 - self.defocus, "mm behind the sensor"),
            Quantity("length of the lens", self.length, "mm, first to last vertex"),
            Quantity("total track", self.total_track, "mm, first vertex to sensor"),
            Quantity("Airy radius", self.airy_radius_um, "µm on the sensor"),
        ]


@torch.no_grad()
def first_order_numbers(
    lens: Lens, wavelength: float, object_distance: float | None = None
) -> FirstOrderNumbers:
    """Return the first-order data of a lens.

    Args:
        lens: the lens.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    first = lens.first_order(wavelength, object_distance)
    vertices = lens.system().vertices
    return FirstOrderNumbers(
        reference_wavelength=wavelength,
        object_distance=math.inf if object_distance is None else object_distance,
        efl=float(first.efl),
        bfd=float(first.bfd),
        ffd=float(first.ffd),
        f_number=float(first.f_number),
        working_f_number=float(first.working_f_number),
        entrance_pupil_z=float(first.entrance_pupil.z),
        entrance_pupil_diameter=float(first.entrance_pupil.diameter),
        exit_pupil_z=float(first.exit_pupil.z),
        exit_pupil_diameter=float(first.exit_pupil.diameter),
        front_principal_z=float(first.front_principal),
        rear_principal_z=float(first.rear_principal),
        magnification=float(first.magnification),
        paraxial_image_z=float(first.image),
        defocus=float(vertices[-1] - first.image),
        length=float(vertices[-2]),
        total_track=float(vertices[-1]),
        airy_radius_um=1e-3 * AIRY * wavelength * abs(float(first.working_f_number)),
    )
