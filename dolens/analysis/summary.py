"""A summary tells a lens's first-order data, Seidel sums and spot sizes at a glance."""

import math
from dataclasses import dataclass

import torch

from dolens.analysis.conditions import FieldPoints, conditions, full_field
from dolens.analysis.ray_intercepts import in_double_precision
from dolens.analysis.spot_diagram import spot_diagram
from dolens.optics.lens import Lens
from dolens.optics.seidel import Seidel
from dolens.optics.tables import html_table, printable, text_table

# Names and symbols of the sums, in the order of `Seidel`.
SEIDEL_NAMES = (
    ("spherical aberration", "S_I"),
    ("coma", "S_II"),
    ("astigmatism", "S_III"),
    ("Petzval", "S_IV"),
    ("distortion", "S_V"),
    ("axial colour", "C_L"),
    ("lateral colour", "C_T"),
)
_RAYS = 2000


@dataclass(frozen=True)
class FieldSummary:
    """One field of a summary.

    Attributes:
        field: (x, y), degrees or mm.
        image: (x, y), mm on the sensor, of the chief ray at the reference wavelength; NaN where it
            does not arrive.
        rms_spot_um: µm, RMS radius of all wavelengths together about their centroid; NaN where no
            light passes.
        geo_spot_um: µm, the largest distance of a ray from its own wavelength's centroid.
    """

    field: tuple[float, float]
    image: tuple[float, float]
    rms_spot_um: float
    geo_spot_um: float


@dataclass(frozen=True)
class LensSummary:
    """A summary of a lens at its reference wavelength; lengths in mm, z from the first vertex.

    Infinite values are `inf`: the EFL of an afocal lens, the pupil of a telecentric one.

    Attributes:
        name: of the lens.
        reference_wavelength: nm.
        wavelengths: nm.
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
        magnification: paraxial, zero for an object at infinity.
        paraxial_image_z: of the axial object point.
        defocus: from the paraxial image to the sensor.
        length: first to last vertex.
        total_track: first vertex to sensor.
        field_unit: `°` or `mm`.
        fields: of the lens.
        airy_radius_um: µm, 1.22·λ·N.
        seidel_field: degrees or mm, the edge of the field that the sums are of.
        seidel: sums of the lens, mm of wave aberration, by name.
        seidel_by_surface: the same of every surface.
    """

    name: str
    reference_wavelength: float
    wavelengths: tuple[float, ...]
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
    magnification: float
    paraxial_image_z: float
    defocus: float
    length: float
    total_track: float
    field_unit: str
    fields: tuple[FieldSummary, ...]
    airy_radius_um: float
    seidel_field: float
    seidel: dict[str, float]
    seidel_by_surface: tuple[dict[str, float], ...]

    def first_order_cells(self) -> list[list[str]]:
        """Return rows of quantity, value and unit of the first-order data."""
        rows = [
            ("effective focal length", self.efl, "mm"),
            ("back focal distance", self.bfd, "mm"),
            ("front focal distance", self.ffd, "mm"),
            ("F-number", self.f_number, ""),
            ("entrance pupil diameter", self.entrance_pupil_diameter, "mm"),
            ("entrance pupil from first vertex", self.entrance_pupil_z, "mm"),
            ("exit pupil diameter", self.exit_pupil_diameter, "mm"),
            ("exit pupil from first vertex", self.exit_pupil_z, "mm"),
            ("length of lens", self.length, "mm"),
            ("total track, first vertex to sensor", self.total_track, "mm"),
            ("sensor behind paraxial image", self.defocus, "mm"),
            ("Airy radius", self.airy_radius_um, "µm"),
        ]
        if math.isfinite(self.object_distance):
            rows[4:4] = [
                ("working F-number", self.working_f_number, ""),
                ("magnification", self.magnification, ""),
                ("object in front of first vertex", self.object_distance, "mm"),
            ]
        return [[what, _number(value), unit] for what, value, unit in rows]

    def seidel_cells(self) -> list[list[str]]:
        """Return rows of aberration, symbol, sum in µm and in waves."""
        wave = 1e-3 * self.reference_wavelength
        return [
            [name, symbol, f"{1e3 * self.seidel[key]:.4g}", f"{1e3 * self.seidel[key] / wave:.3g}"]
            for (name, symbol), key in zip(SEIDEL_NAMES, Seidel._fields, strict=True)
        ]

    def field_cells(self) -> list[list[str]]:
        """Return rows of field, image point, RMS and largest spot radius."""
        return [
            [_pair(row.field), _pair(row.image), _spot(row.rms_spot_um), _spot(row.geo_spot_um)]
            for row in self.fields
        ]

    @property
    def field_headings(self) -> tuple[str, ...]:
        """Return the headings of `field_cells`."""
        unit = self.field_unit
        return (f"field ({unit})", "image (mm)", "RMS spot (µm)", "largest (µm)")

    @property
    def seidel_headings(self) -> tuple[str, ...]:
        """Return the headings of `seidel_cells`."""
        edge = f"{self.seidel_field:g}{'' if self.field_unit == '°' else ' '}{self.field_unit}"
        return (f"Seidel sums, field {edge}", "", "µm", "waves")

    @property
    def heading(self) -> str:
        """Return the lens's name and the wavelengths."""
        lines = ", ".join(f"{wave:g}" for wave in self.wavelengths)
        reference = f", reference {self.reference_wavelength:g} nm"
        return printable(f"{self.name or 'Lens'}: {lines} nm") + (
            reference if len(self.wavelengths) > 1 else ""
        )

    def __repr__(self) -> str:
        """Return the summary as text."""
        return "\n\n".join(
            [
                self.heading,
                text_table(("first order", "", ""), self.first_order_cells()),
                text_table(self.field_headings, self.field_cells()),
                text_table(self.seidel_headings, self.seidel_cells(), 2),
            ]
        )

    def _repr_html_(self) -> str:
        """Return the summary as HTML, all text escaped."""
        return (
            html_table(("first order", "", ""), self.first_order_cells(), self.heading)
            + html_table(self.field_headings, self.field_cells())
            + html_table(self.seidel_headings, self.seidel_cells(), left=2)
        )


@torch.no_grad()
def lens_summary(
    lens: Lens,
    fields: FieldPoints | None = None,
    wavelengths: list[float] | None = None,
    object_distance: float | None = None,
) -> LensSummary:
    """Summarise a lens.

    Args:
        lens: the lens.
        fields: as `conditions` takes them; None for the lens's own or the defaults.
        wavelengths: nm; None for the lens's own.
        object_distance: mm, `inf` for infinity; None for the lens's own.

    Raises:
        InputError: fields or wavelengths that are none.
    """
    exact = in_double_precision(lens)
    given = conditions(lens, fields, wavelengths, object_distance)
    wave, distance = given.reference_wavelength, given.object_distance
    first = exact.first_order(wave, distance)
    spots = spot_diagram(exact, given.fields, given.wavelengths, _RAYS, distance)
    edge = float(given.fields.norm(dim=-1).max()) or full_field(exact, distance)
    waves = given.wavelengths.tolist()
    colour = (min(waves), max(waves)) if min(waves) < max(waves) else (486.1327, 656.2725)
    sums = exact.seidel(edge, wave, distance, colour)
    vertices = exact.system().vertices
    geo = spots.geo.nan_to_num(-math.inf).amax(-1)
    nearest = int((given.wavelengths - wave).abs().argmin())

    return LensSummary(
        name=lens.name,
        reference_wavelength=wave,
        wavelengths=tuple(waves),
        object_distance=math.inf if distance is None else distance,
        efl=float(first.efl),
        bfd=float(first.bfd),
        ffd=float(first.ffd),
        f_number=float(first.f_number),
        working_f_number=float(first.working_f_number),
        entrance_pupil_z=float(first.entrance_pupil.z),
        entrance_pupil_diameter=float(first.entrance_pupil.diameter),
        exit_pupil_z=float(first.exit_pupil.z),
        exit_pupil_diameter=float(first.exit_pupil.diameter),
        magnification=float(first.magnification),
        paraxial_image_z=float(first.image),
        defocus=float(vertices[-1] - first.image),
        length=float(vertices[-2]),
        total_track=float(vertices[-1]),
        field_unit=given.field_unit,
        fields=tuple(
            FieldSummary(tuple(field), tuple(image), 1e3 * rms, 1e3 * far)
            for field, image, rms, far in zip(
                given.fields.tolist(),
                spots.chief.tolist(),
                spots.polychromatic_rms.tolist(),
                geo.where(geo >= 0.0, math.nan).tolist(),
                strict=True,
            )
        ),
        airy_radius_um=1e3 * float(spots.airy_radius[nearest]),
        seidel_field=edge,
        seidel={key: float(value) for key, value in sums.total._asdict().items()},
        seidel_by_surface=tuple(
            {key: float(values[at]) for key, values in sums._asdict().items()}
            for at in range(len(exact.surfaces))
        ),
    )


def _number(value: float) -> str:
    return f"{value:.6g}"


def _pair(point: tuple[float, float]) -> str:
    x, y = (0.0 if abs(value) < 1e-9 else value for value in point)
    if math.isnan(x) or math.isnan(y):
        return "none"
    return f"{y:.5g}" if x == 0.0 else f"({x:.5g}, {y:.5g})"


def _spot(radius: float) -> str:
    return "no light" if math.isnan(radius) else f"{radius:.4g}"
