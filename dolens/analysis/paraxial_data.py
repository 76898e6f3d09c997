"""First-order data and Seidel sums, which paraxial rays give, as plain numbers with names."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions, full_field, wavelength_interval
from dolens.analysis.spot_diagram import AIRY
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.seidel import Seidel

# Sections that differ by less, of themselves or in mm, are alike.
_ALIKE = 1e-6


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


class SectionNumbers(NamedTuple):
    """First-order data of one section of a lens whose two sections differ, mm.

    Attributes:
        name: `x–z` or `y–z`.
        efl: effective focal length.
        bfd: back focal distance.
        f_number: EFL over the entrance pupil's diameter.
        entrance_pupil_diameter: along the section.
        defocus: from the paraxial image to the sensor.
    """

    name: str
    efl: float
    bfd: float
    f_number: float
    entrance_pupil_diameter: float
    defocus: float


@dataclass(frozen=True)
class FirstOrderNumbers:
    """First-order data of a lens at its reference wavelength; lengths in mm, z from the first
    vertex.

    Infinite values are `inf`: the EFL of an afocal lens, the pupil of a telecentric one.  Of a lens
    whose two sections differ the numbers are those of its mean curvatures, and `sections` has those
    of each.

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
        sections: x–z and y–z where they differ, else empty.
        stop_note: a sentence where the stop is smaller than the aperture that the prescription asks
            for, else empty.
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
    sections: tuple[SectionNumbers, ...]
    stop_note: str

    def quantities(self) -> list[Quantity]:
        """Return the rows of a table; those of a near object only where there is one."""
        near = [
            Quantity("working F-number", self.working_f_number, ""),
            Quantity("magnification", self.magnification, ""),
            Quantity("object distance", self.object_distance, "mm in front of the first vertex"),
        ]
        from_first = "mm from the first vertex"
        return [
            *self._by_section("effective focal length", "efl", "mm"),
            *self._by_section("back focal distance", "bfd", "mm behind the last vertex"),
            Quantity("front focal distance", self.ffd, from_first),
            *self._by_section("F-number", "f_number", "focal length over entrance pupil"),
            *(near if math.isfinite(self.object_distance) else ()),
            *self._by_section("entrance pupil diameter", "entrance_pupil_diameter", "mm"),
            Quantity("entrance pupil position", self.entrance_pupil_z, from_first),
            Quantity("exit pupil diameter", self.exit_pupil_diameter, "mm"),
            Quantity("exit pupil position", self.exit_pupil_z, from_first),
            Quantity("front principal plane", self.front_principal_z, from_first),
            Quantity("rear principal plane", self.rear_principal_z, from_first),
            *self._by_section("paraxial image", "defocus", "mm behind the sensor", -1.0),
            Quantity("length of the lens", self.length, "mm, first to last vertex"),
            Quantity("total track", self.total_track, "mm, first vertex to sensor"),
            Quantity("Airy radius", self.airy_radius_um, "µm on the sensor"),
        ]

    @property
    def note(self) -> str:
        """Return what a reader of the table must know; empty for most lenses."""
        mean = "What names no section is that of the mean curvatures of both."
        return " ".join(filter(None, (mean if self.sections else "", self.stop_note)))

    def _by_section(self, name: str, what: str, unit: str, sign: float = 1.0) -> list[Quantity]:
        """Return a quantity of the lens, or of each section where these differ."""
        values = {getattr(own, what) for own in self.sections}
        if len(values) < 2:
            return [Quantity(name, 0.0 + sign * getattr(self, what), unit)]
        return [
            Quantity(f"{name}, {own.name}", 0.0 + sign * getattr(own, what), unit)
            for own in self.sections
        ]


@torch.no_grad()
def first_order_numbers(lens: Lens, where: Conditions) -> FirstOrderNumbers:
    """Return the first-order data of a lens.

    Args:
        lens: the lens.
        where: reference wavelength and object distance.
    """
    wavelength, object_distance = where.reference_wavelength, where.object_distance
    first = lens.first_order(wavelength, object_distance)
    vertices = lens.system().vertices
    both = []
    for meridian in "xy":
        own = lens.first_order(wavelength, object_distance, meridian)
        numbers = own.efl, own.bfd, own.f_number, own.entrance_pupil.diameter
        values = *map(float, numbers), float(vertices[-1] - own.image)
        both.append(SectionNumbers(f"{meridian}–z", *values))
    alike = all(
        one == other or math.isclose(one, other, rel_tol=_ALIKE, abs_tol=_ALIKE)
        for one, other in zip(both[0][1:], both[1][1:], strict=True)
    )
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
        sections=() if alike else tuple(both),
        stop_note=lens.stop_note,
    )


class Aberration(NamedTuple):
    """An `Aberration` is a Seidel sum by name.

    Attributes:
        name: in full.
        short: for the head of a narrow column.
        symbol: of its sum.
    """

    name: str
    short: str
    symbol: str


# In the order of `Seidel`.
ABERRATIONS = (
    Aberration("spherical aberration", "spherical", "S_I"),
    Aberration("coma", "coma", "S_II"),
    Aberration("astigmatism", "astigm.", "S_III"),
    Aberration("Petzval", "Petzval", "S_IV"),
    Aberration("distortion", "distort.", "S_V"),
    Aberration("axial colour", "axial", "C_L"),
    Aberration("lateral colour", "lateral", "C_T"),
)


@dataclass(frozen=True)
class SeidelSums:
    """Seidel sums of N surfaces, those of the centred lens without poses.

    Attributes:
        edge: of the field, degrees or mm.
        wavelength: nm.
        colours: nm, the shorter and the longer wavelength of the sums of colour.
        by_surface: (N,) each, mm of wave aberration, float64.
    """

    edge: float
    wavelength: float
    colours: tuple[float, float]
    by_surface: Seidel

    def waves(self) -> Tensor:
        """Return the sums in wavelengths, (N, 7)."""
        return torch.stack(list(self.by_surface), -1) / (1e-6 * self.wavelength)


@torch.no_grad()
def seidel_sums(lens: Lens, where: Conditions) -> SeidelSums:
    """Return the sums at the farthest field, or at the full field where all are on the axis.

    The sums of colour are between the outermost wavelengths; where there is one only, between those
    of `wavelength_interval`.

    Args:
        lens: of any precision.
        where: fields, wavelengths and object distance.
    """
    exact = in_double_precision(lens)
    wavelength, distance = where.reference_wavelength, where.object_distance
    edge = float(where.fields.norm(dim=-1).max()) or full_field(exact, distance)
    if vergence(distance) == 0.0:
        require_from_the_front(edge, "a paraxial chief ray")
    low, high = float(where.wavelengths.min()), float(where.wavelengths.max())
    colours = (low, high) if low < high else wavelength_interval(lens)
    found = exact.seidel(edge, wavelength, distance, colours)
    return SeidelSums(edge, wavelength, colours, Seidel(*(sums.cpu() for sums in found)))
