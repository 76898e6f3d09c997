"""A summary tells a lens's first-order data, Seidel sums and spot sizes at a glance."""

import math
from dataclasses import dataclass

import torch

from dolens.analysis.conditions import Conditions
from dolens.analysis.paraxial_data import (
    ABERRATIONS,
    FirstOrderNumbers,
    first_order_numbers,
    seidel_sums,
)
from dolens.analysis.spot_diagram import spot_diagram
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import point_text, weights_text
from dolens.optics.lens import Lens
from dolens.optics.text_tables import html_table, printable, text_table

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
        geo_spot_um: µm, the largest distance of a ray from its own wavelength's centroid, of the
            wavelengths that count.
    """

    field: tuple[float, float]
    image: tuple[float, float]
    rms_spot_um: float
    geo_spot_um: float


@dataclass(frozen=True)
class LensSummary(FirstOrderNumbers):
    """First-order data, spot sizes and Seidel sums of a lens.

    Attributes:
        name: of the lens.
        wavelengths: nm.
        weights: shares of the wavelengths in polychromatic values; they sum to one.
        field_unit: `°` or `mm`.
        fields: of the lens.
        seidel_field: degrees or mm, the edge of the field that the sums are of.
        seidel: sums of the lens, mm of wave aberration, by name; none where a medium is a crystal
            or a gradient, of which no sums hold.
        seidel_by_surface: the same of every surface.
    """

    name: str
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    field_unit: str
    fields: tuple[FieldSummary, ...]
    seidel_field: float
    seidel: dict[str, float]
    seidel_by_surface: tuple[dict[str, float], ...]

    def first_order_cells(self) -> list[list[str]]:
        """Return rows of quantity, value and unit of the first-order data."""
        return [
            [quantity.name, f"{quantity.value:.{quantity.digits}g}", quantity.unit]
            for quantity in self.quantities()
        ]

    def seidel_cells(self) -> list[list[str]]:
        """Return rows of aberration, symbol, sum in µm and in waves."""
        wave = 1e-3 * self.reference_wavelength
        return [
            [entry.name, entry.symbol, f"{1e3 * value:.4g}", f"{1e3 * value / wave:.3g}"]
            for entry, value in zip(ABERRATIONS, self.seidel.values(), strict=bool(self.seidel))
        ]

    def field_cells(self) -> list[list[str]]:
        """Return rows of field, image point, RMS and largest spot radius."""
        return [
            [
                point_text(row.field, 5),
                _image(row.image),
                _spot(row.rms_spot_um),
                _spot(row.geo_spot_um),
            ]
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
        weights = weights_text(self.weights)
        return printable(f"{self.name or 'Lens'}: {lines} nm{weights}") + (
            reference if len(self.wavelengths) > 1 else ""
        )

    def __repr__(self) -> str:
        """Return the summary as text."""
        note, cells = [self.note] if self.note else [], self.seidel_cells()
        return "\n\n".join(
            [
                self.heading,
                text_table(("first order", "", ""), self.first_order_cells(), {0, 2}),
                *note,
                text_table(self.field_headings, self.field_cells()),
                *([text_table(self.seidel_headings, cells, {0, 1})] if cells else []),
            ]
        )

    def _repr_html_(self) -> str:
        """Return the summary as HTML, all text escaped."""
        cells = self.seidel_cells()
        return (
            html_table(
                *(("first order", "", ""), self.first_order_cells(), self.heading, {0, 2}),
                self.note,
            )
            + html_table(self.field_headings, self.field_cells())
            + (html_table(self.seidel_headings, cells, left={0, 1}) if cells else "")
        )


@torch.no_grad()
def lens_summary(lens: Lens, given: Conditions) -> LensSummary:
    """Summarise a lens at given conditions."""
    exact = in_double_precision(lens)
    spots = spot_diagram(exact, given, _RAYS)
    system = exact.system()
    sums = None if system.gradients or system.anisotropic else seidel_sums(exact, given)
    by_surface = {} if sums is None else sums.by_surface._asdict()
    geo = spots.geo[:, spots.where.weights > 0.0].nan_to_num(-math.inf).amax(-1)
    first = first_order_numbers(exact, given)
    return LensSummary(
        **vars(first),
        name=lens.name,
        wavelengths=tuple(given.wavelengths.tolist()),
        weights=tuple(given.weights.tolist()),
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
        seidel_field=math.nan if sums is None else sums.edge,
        seidel={key: float(values.sum(-1)) for key, values in by_surface.items()},
        seidel_by_surface=tuple(
            {key: float(values[at]) for key, values in by_surface.items()}
            for at in range(len(exact.surfaces) if by_surface else 0)
        ),
    )


def _image(point: tuple[float, float]) -> str:
    """Return an image point as text; a rounding error from the axis is on the axis."""
    x, y = (0.0 if abs(value) < 1e-9 else value for value in point)
    return "none" if math.isnan(x) or math.isnan(y) else point_text((x, y), 5)


def _spot(radius: float) -> str:
    return "no light" if math.isnan(radius) else f"{radius:.4g}"
