"""The prescription of a lens as a table of plain values: what `repr(lens)` and pages show."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch

from dolens.optics.elements import TILTS, Element, carriers
from dolens.optics.materials import LINE_C, LINE_F, MIRROR, Medium, abbe_number, index_d
from dolens.optics.parameter_names import to_file_units
from dolens.optics.surfaces import CoordinateBreak
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Ellipse, Rectangle
from dolens.optics.surfaces.outlines import Polygons
from dolens.optics.text_tables import html_table, printable, text_table

HEADINGS = (
    "surface",
    "type",
    "radius (mm)",
    "thickness (mm)",
    "material",
    "semi-diameter (mm)",
    "conic",
    "further terms",
)
# More names of coefficients than these are counted.
_NAMED = 4


@dataclass(frozen=True)
class SurfaceRow:
    """One surface of a prescription.

    Attributes:
        number: from 1.
        kind: the surface's type, as prescriptions write it.
        radius: mm, `inf` for a plane; None for a shape without one.
        thickness: mm, to the next surface or the sensor.
        material: the medium behind the surface; `mirror` where it reflects, and nothing of a
            coordinate break.
        index_d: its index at the d line; NaN of a glass that is specified elsewhere only.
        abbe_number: its Abbe number Vd, `inf` without dispersion; NaN likewise.
        semi_diameter: mm, of the clear aperture's farthest point; NaN of a coordinate break.
        aperture: `circle`, `rectangle` or `none`, and its obscuration where there is one.
        conic: None for a shape without one.
        terms: further coefficients by name; the lists of numbers of a shape, such as a spline's,
            are left out.  Of a coordinate break its decenters, mm, and tilts, degrees.
        stop: whether it is the stop.
        element: name of the innermost element with a pose of its own that carries it, or nothing.
    """

    number: int
    kind: str
    radius: float | None
    thickness: float
    material: str
    index_d: float
    abbe_number: float
    semi_diameter: float
    aperture: str
    conic: float | None
    terms: dict[str, float]
    stop: bool
    element: str

    @property
    def mark(self) -> str:
        """Return which further terms shape the surface, in a few words."""
        used = [name for name, value in self.terms.items() if value != 0.0]
        if self.kind == CoordinateBreak.kind:
            return ", ".join(f"{n} {_number(self.terms[n])}{_unit(n)}" for n in used)
        if not self.terms:
            return ""
        if not used:
            return f"{len(self.terms)} terms, all 0" if len(self.terms) > 1 else "1 term, 0"
        return ", ".join(used) if len(used) <= _NAMED else f"{len(used)} terms"

    def cells(self) -> list[str]:
        """Return the row as text, under `HEADINGS`."""
        extent = "" if math.isnan(self.semi_diameter) else _number(self.semi_diameter)
        if extent and self.aperture != "circle":
            extent += f" ({self.aperture})"
        return [
            f"{self.number} (stop)" if self.stop else str(self.number),
            self.kind,
            "" if self.radius is None else _number(self.radius),
            _number(self.thickness),
            self.material,
            extent,
            "" if not self.conic else _number(self.conic),
            self.mark,
        ]


@dataclass(frozen=True)
class PrescriptionTable:
    """The prescription of a lens.

    Attributes:
        name: of the lens.
        index_model: of its materials.
        object_distance: mm in front of the first vertex, `inf` for infinity.
        object_material: the medium in front of the lens.
        surfaces: in the order that light meets them.
        sensor_distance: mm from the last vertex.
        sensor_diameter: mm; None where the prescription gives none.
        elements: name of an element with a pose → its parameters that are not zero, degrees and mm.
        carried: name of an element with a pose → the first and the last of its surfaces.
        sensor_radius: mm, of a curved sensor; `inf` of a plane one.
        sensor_conic: its conic constant; 0 of a sphere.
        coatings: what a coating is, in words → the surfaces that have it.
        diffractive: number of a surface → its diffractive element, in words.
    """

    name: str
    index_model: str
    object_distance: float
    object_material: str
    surfaces: tuple[SurfaceRow, ...]
    sensor_distance: float
    sensor_diameter: float | None
    elements: dict[str, dict[str, float]]
    carried: dict[str, tuple[int, int]]
    sensor_radius: float = math.inf
    sensor_conic: float = 0.0
    coatings: dict[str, tuple[int, ...]] = field(default_factory=dict)
    diffractive: dict[int, str] = field(default_factory=dict)

    @property
    def heading(self) -> str:
        """Return the lens's name and number of surfaces, in one line."""
        count = len(self.surfaces)
        plural = "surface" if count == 1 else "surfaces"
        return printable(f"{self.name or 'Lens'}: {count} {plural}, index model {self.index_model}")

    @property
    def notes(self) -> list[str]:
        """Return lines about coatings, and about elements with a pose of their own."""
        found = [
            printable(f"coating of {_surfaces(numbers)}: {coating}")
            for coating, numbers in self.coatings.items()
        ]
        found += [
            f"diffractive element of surface {n}: {said}" for n, said in self.diffractive.items()
        ]
        for name, pose in self.elements.items():
            first, last = self.carried[name]
            values = ", ".join(f"{key} {_number(value)}{_unit(key)}" for key, value in pose.items())
            which = f"surfaces {first} to {last}"
            found.append(printable(f"element {name} ({which}): {values or 'no tilt or shift'}"))
        return found

    def cells(self) -> list[list[str]]:
        """Return rows of text under `HEADINGS`: object, surfaces, sensor."""
        sensor = "" if self.sensor_diameter is None else _number(0.5 * self.sensor_diameter)
        first = ["object", "", "", _number(self.object_distance), self.object_material, "", "", ""]
        last = ["sensor", "plane", "", "", "", sensor, "", ""]
        if not math.isinf(self.sensor_radius):
            last[1] = "conic" if self.sensor_conic else "sphere"
            last[2] = _number(self.sensor_radius)
            last[6] = _number(self.sensor_conic) if self.sensor_conic else ""
        return [first, *(row.cells() for row in self.surfaces), last]

    def text(self) -> str:
        """Return the table as lines of text."""
        return "\n".join([self.heading, text_table(HEADINGS, self.cells(), {0, 1}), *self.notes])

    def html(self) -> str:
        """Return the table as HTML, all text escaped."""
        rows = [["∞" if cell == "inf" else cell for cell in row] for row in self.cells()]
        notes = [[note] for note in self.notes]
        beside = html_table(["notes"], notes) if notes else ""
        return html_table(HEADINGS, rows, self.heading, {0, 1}) + beside


@torch.no_grad()
def prescription_table(lens: Any) -> PrescriptionTable:
    """Return the prescription of a `Lens` in its present state as plain values."""
    carried = {name: (element.first, element.last) for name, element in lens.elements.items()}
    names, spans = list(carried), list(carried.values())
    carrier = {
        number: names[inner_first[0]]
        for number in range(1, len(lens.surfaces) + 1)
        if (inner_first := carriers(spans, number))
    }
    gaps = [float(gap) for gap in lens.thicknesses.values()] + [float(lens.sensor_distance)]
    rows = []
    surfaces = zip(lens.surfaces.values(), gaps, lens.materials[1:], strict=True)
    for number, (surface, gap, medium) in enumerate(surfaces, 1):
        values = {
            name: float(value)
            for name, value in surface.named_parameters()
            if value.ndim == 0 and not name.startswith(("coating.", "gradient."))
        }
        if surface.changes_axes:
            turned = {n: to_file_units(n, value) for n, value in values.items()}
            rows.append(_break_row(number, surface.kind, gap, turned, carrier.get(number, "")))
            continue
        curvature = values.pop("curvature", None)
        conic = values.pop("conic", None)
        radius = math.inf if surface.flat else None
        if curvature is not None:
            radius = math.inf if curvature == 0.0 else 1.0 / curvature
        rows.append(
            SurfaceRow(
                number,
                surface.kind,
                radius,
                gap,
                medium.name,
                *_glass_numbers(medium),
                surface.semi_diameter,
                _aperture(surface.aperture),
                conic,
                values,
                number == lens.stop,
                carrier.get(number, ""),
            )
        )
    return PrescriptionTable(
        lens.name,
        lens.index_model,
        math.inf if lens.object_distance is None else float(lens.object_distance),
        lens.materials[0].name,
        tuple(rows),
        gaps[-1],
        lens.sensor_diameter,
        {name: _pose(element) for name, element in lens.elements.items()},
        carried,
        *_sensor_shape(lens),
        _coatings(lens),
        {
            number: surface.diffractive.description
            for number, surface in enumerate(lens.surfaces.values(), 1)
            if surface.diffractive is not None
        },
    )


def _coatings(lens: Any) -> dict[str, tuple[int, ...]]:
    """Return what coatings there are, and their surfaces."""
    found: dict[str, tuple[int, ...]] = {}
    for number, surface in enumerate(lens.surfaces.values(), 1):
        if surface.coating is not None:
            said = surface.coating.description
            found[said] = (*found.get(said, ()), number)
    return found


def _surfaces(numbers: tuple[int, ...]) -> str:
    """Return `surface 1` or `surfaces 1, 2 and 4`."""
    *others, last = map(str, numbers)
    return f"surfaces {', '.join(others)} and {last}" if others else f"surface {last}"


def _sensor_shape(lens: Any) -> tuple[float, float]:
    """Return radius (mm) and conic constant of the sensor."""
    curvature, conic = lens.sensor_curvature, lens.sensor_conic
    radius = math.inf if curvature is None or float(curvature) == 0.0 else 1.0 / float(curvature)
    return radius, 0.0 if conic is None else float(conic)


def _break_row(
    number: int, kind: str, gap: float, terms: dict[str, float], element: str
) -> SurfaceRow:
    """Return the row of a coordinate break."""
    nan = math.nan
    return SurfaceRow(
        number, kind, None, gap, "", nan, nan, nan, "", None, terms, stop=False, element=element
    )


def _unit(name: str) -> str:
    return "°" if name in TILTS else " mm"


def _glass_numbers(medium: Medium) -> tuple[float, float]:
    """Return nd and Vd; NaN of a mirror, and where the catalogue ends short of lines F, d and C."""
    if medium is MIRROR:
        return math.nan, math.nan
    first, last = getattr(medium, "wavelengths", (0.0, math.inf))
    if first > LINE_F or last < LINE_C:
        return math.nan, math.nan
    return index_d(medium), abbe_number(medium)


def _pose(element: Element) -> dict[str, float]:
    """Return the pose's numbers that are not zero, tilts in degrees."""
    pose = {name: float(value) for name, value in element.named_parameters()}
    pose |= {name: math.degrees(pose[name]) for name in TILTS}
    return {name: value for name, value in pose.items() if value != 0.0}


def _aperture(aperture: ClearAperture) -> str:
    edge = aperture.edge
    if isinstance(edge, Rectangle):
        found = f"rectangle {_number(2.0 * edge.half_width_x)} × {_number(2.0 * edge.half_width_y)}"
    elif isinstance(edge, Ellipse):
        found = f"ellipse {_number(2.0 * edge.semi_axis_x)} × {_number(2.0 * edge.semi_axis_y)}"
    elif isinstance(edge, Polygons):
        found = edge.words(_number)
    else:
        found = "circle" if isinstance(edge, Circle) else "no edge"
    if aperture.window is not None:
        found = f"{found} and {_aperture(ClearAperture(aperture.window))}"
    if any(aperture.center):
        found = f"{found} about ({', '.join(_number(value) for value in aperture.center)})"
    return f"{found}, obscured" if aperture.obscuration is not None else found


def _number(value: float) -> str:
    return f"{value:.7g}"
