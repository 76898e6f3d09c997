"""The overview of a lens is its first page: the tables that a terminal shows too."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from dolens.analysis.conditions import Conditions, conditions
from dolens.analysis.first_order_numbers import first_order_numbers
from dolens.analysis.spot_diagram import SpotDiagram, spot_diagram
from dolens.errors import InputError
from dolens.lens_page.published_table import published_table
from dolens.lens_page.states_table import states_table
from dolens.lens_page.tables import (
    Table,
    first_order_table,
    number,
    prescription_tables,
    seidel_table,
    spot_radii_table,
)
from dolens.optics.fields import field_label, weights_text
from dolens.optics.lens import Lens

# Of each spot; RMS radii err by 1e-4 of themselves or so.
_RAYS = 2000


@dataclass(frozen=True)
class TableSection:
    """A section of tables.

    Attributes:
        title: its heading.
        tables: what could be computed.
        problems: what could not, and why, a sentence each.
    """

    title: str
    tables: list[Table] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Overview:
    """An overview of a lens at its conditions.

    Attributes:
        name: of the lens.
        summary: focal length, F-number, fields and wavelengths in one line.
        conditions: fields, wavelengths and object distance of everything.
        sections: prescription, states of a lens that has some, first-order data, what the source
            publishes where the prescription says it, Seidel sums, spot radii.
        spots: the spots, or None where they could not be traced.
    """

    name: str
    summary: str
    conditions: Conditions
    sections: list[TableSection]
    spots: SpotDiagram | None


@torch.no_grad()
def lens_overview(lens: Lens) -> Overview:
    """Compute the tables of a lens, at its own fields, wavelengths and object distance.

    Args:
        lens: centred or with poses, of any precision.

    Raises:
        InputError: the lens names conditions that no analysis can take.
    """
    where = conditions(lens)
    found: list[SpotDiagram] = []

    def spots() -> Table:
        found.append(
            spot_diagram(lens, where.fields, where.wavelengths, _RAYS, where.object_distance)
        )
        return spot_radii_table(found[0])

    sections = [TableSection("Prescription", prescription_tables(lens))]
    for title, make in (
        *([("States", lambda: states_table(lens))] if lens.states else []),
        ("First-order data", lambda: first_order_table(lens, where)),
        *([("Published numbers", lambda: published_table(lens, where))] if lens.published else []),
        ("Seidel sums", lambda: seidel_table(lens, where)),
        ("RMS spot radii", spots),
    ):
        sections.append(_section(title, make))
    return Overview(
        lens.name or "Lens", summary(lens, where), where, sections, found[0] if found else None
    )


def summary(lens: Lens, where: Conditions) -> str:
    """Return focal length, F-number, fields and wavelengths of a lens in one line."""
    first = first_order_numbers(lens, where.reference_wavelength, where.object_distance)
    if first.sections:
        parts = [f"{_focal_length(own.efl)} in {own.name}" for own in first.sections]
    else:
        parts = [_focal_length(first.efl)]
    # Of two sections, that of y–z, which files mean.
    y = lens.first_order(where.reference_wavelength, where.object_distance, "y")
    of_section = f" in {first.sections[-1].name}" if first.sections else ""
    parts.append(f"F/{number(abs(float(y.working_f_number)), 3)}{of_section}")
    if where.object_distance is not None:
        parts.append(f"object at {number(where.object_distance)} mm")
    fields = ", ".join(field_label(point, where.field_unit) for point in where.fields)
    waves = ", ".join(f"{float(wave):g}" for wave in where.wavelengths)
    many = len(where.wavelengths) > 1
    parts.append(
        f"field{'s' * (len(where.fields) > 1)} {fields}{weights_text(where.field_weights)}"
    )
    parts.append(f"wavelength{'s' * many} {waves} nm{weights_text(where.weights)}")
    if many:
        parts.append(f"reference {where.reference_wavelength:g} nm")
    return " · ".join(parts)


def _focal_length(efl: float) -> str:
    return f"f = {number(efl)} mm" if abs(efl) < 1e9 else "afocal"


def _section(title: str, make: Callable[[], Table]) -> TableSection:
    try:
        return TableSection(title, [make()])
    except InputError as error:
        return TableSection(title, problems=[str(error)])
