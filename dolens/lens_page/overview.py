"""The overview of a lens at conditions of one's own: the tables of a page and of a terminal."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from dolens.analysis.conditions import Conditions, conditions
from dolens.analysis.fields_and_wavelengths import as_wavelengths, field_points, spectral_shares
from dolens.analysis.paraxial_data import first_order_numbers
from dolens.analysis.spot_diagram import SpotDiagram, spot_diagram
from dolens.errors import InputError
from dolens.lens_page.tables import (
    Table,
    first_order_table,
    ghost_tables,
    ghosts_of_fields,
    number,
    prescription_tables,
    seidel_table,
    spot_radii_table,
)
from dolens.optics.field_and_aperture import with_aperture
from dolens.optics.fields import Fields, field_label, weights_text
from dolens.optics.lens import Lens
from dolens.optics.lens_data import Published
from dolens.optics.parameter_names import to_file_units

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
def lens_overview(lens: Lens, ghosts: bool = False) -> Overview:
    """Compute the tables of a lens, at its own fields, wavelengths and object distance.

    Args:
        lens: centred or with poses, of any precision.
        ghosts: whether to list its ghosts.

    Raises:
        InputError: the lens names conditions that no analysis can take.
    """
    where = conditions(lens)
    found: list[SpotDiagram] = []

    def spots() -> Table:
        found.append(spot_diagram(lens, where, _RAYS))
        return spot_radii_table(found[0])

    sections = [TableSection("Prescription", prescription_tables(lens))]
    made: list[tuple[str, Callable[[], Table | list[Table]]]] = [
        *([("States", lambda: states_table(lens))] if lens.states else []),
        ("First-order data", lambda: first_order_table(lens, where)),
        *([("Published numbers", lambda: published_table(lens, where))] if lens.published else []),
        ("Seidel sums", lambda: seidel_table(lens, where)),
        ("RMS spot radii", spots),
        *([("Ghosts", lambda: ghost_tables(ghosts_of_fields(lens, where)))] if ghosts else []),
    ]
    sections += [_section(title, make) for title, make in made]
    return Overview(
        lens.name or "Lens", summary(lens, where), where, sections, found[0] if found else None
    )


def summary(lens: Lens, where: Conditions) -> str:
    """Return focal length, F-number, fields and wavelengths of a lens in one line."""
    first = first_order_numbers(lens, where)
    if first.sections:
        parts = [f"{_focal_length(own.efl)} in {own.name}" for own in first.sections]
    else:
        parts = [_focal_length(first.efl)]
    # Of two sections, that of y–z, which files mean.
    y = lens.first_order(where.reference_wavelength, where.object_distance, "y")
    of_section = f" in {first.sections[-1].name}" if first.sections else ""
    working = "" if where.object_distance is None else "working "
    parts.append(f"{working}F/{number(abs(float(y.working_f_number)), 3)}{of_section}")
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


def _section(title: str, make: Callable[[], Table | list[Table]]) -> TableSection:
    try:
        found = make()
        return TableSection(title, found if isinstance(found, list) else [found])
    except InputError as error:
        return TableSection(title, problems=[str(error)])


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
    lens = lens.storing_its_values().to(device="cpu", dtype=torch.float64)
    lens.requires_grad_(False)
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


# Attribute of `Published` → name of the quantity and its unit.
_ROWS = {
    "efl": ("effective focal length", "mm"),
    "f_number": ("F-number", ""),
    "na": ("numerical aperture, image", ""),
    "object_na": ("numerical aperture, object", ""),
    "entrance_pupil_diameter": ("entrance pupil diameter", "mm"),
    "half_field": ("half field", "°"),
    "image_height": ("image height", "mm"),
    "object_height": ("object height", "mm"),
    "bfd": ("back focal distance", "mm"),
    "length": ("length of the lens", "mm"),
    "track": ("total track", "mm"),
    "magnification": ("magnification", ""),
}


@torch.no_grad()
def published_table(lens: Lens, where: Conditions) -> Table:
    """Return the published numbers of a lens, and the same quantities computed at its conditions.

    Fields are not computed: the fields of the lens are those that it is used with.  The focal
    length is compared without its sign, which is negative behind an intermediate image.

    Args:
        lens: a lens whose `published` is not None.
        where: its conditions.
    """
    published = lens.published or Published()
    found = first_order_numbers(lens, where)
    computed = {
        "efl": abs(found.efl),
        "f_number": abs(found.f_number),
        "na": abs(0.5 / found.working_f_number),
        "entrance_pupil_diameter": found.entrance_pupil_diameter,
        "bfd": found.bfd,
        "length": found.length,
        "track": found.total_track,
        "magnification": found.magnification,
    }
    if where.object_distance is not None:
        # The paraxial marginal ray has n·u = m·n'·u'; the aperture is a sine.
        n = float(lens.materials[0].index(where.reference_wavelength))
        slope = abs(found.magnification * computed["na"]) / n
        computed["object_na"] = n * math.sin(math.atan(slope))
    rows = []
    for key, (name, unit) in _ROWS.items():
        value = getattr(published, key)
        if value is None:
            continue
        said = number(value, 7)
        if key == "efl" and published.efl_tolerance is not None:
            said += f" ± {number(published.efl_tolerance, 3)}"
        rows.append((name, said, number(computed[key], 7) if key in computed else "", unit))
    parts = [published.kind, lens.source, published.note]
    caption = ". ".join(part.strip().rstrip(".") for part in parts if part)
    return Table(
        ("quantity", "published", "computed", "unit"),
        rows,
        caption[:1].upper() + caption[1:] + "." if caption else "",
        frozenset({0, 3}),
    )


@torch.no_grad()
def states_table(lens: Lens) -> Table:
    """Return a column for every state: focal length, F-number, edge of the field, object distance,
    track, temperature, and the parameters that any state has for itself.

    Args:
        lens: with states.

    Raises:
        InputError: a state's conditions are none that an analysis can take; the message names it.
    """
    own = dict.fromkeys(
        base for name in lens.state_names for base, _ in lens.states[name].named_parameters()
    )
    shown = [base for base in own if lens.get_parameter(base).ndim == 0]
    columns = []
    for name in lens.state_names:
        there = lens.in_state(name)
        try:
            where = conditions(there)
        except InputError as error:
            raise InputError(f"state '{name}': {error}") from None
        first = first_order_numbers(there, where)
        edge = max(math.hypot(*point) for point in where.fields.tolist())
        distance = math.inf if where.object_distance is None else where.object_distance
        efl = None if there.published is None else there.published.efl
        values = [to_file_units(base, float(there.get_parameter(base))) for base in shown]
        columns.append(
            (
                " × ".join(number(own.efl) for own in first.sections or (first,)),
                "" if efl is None else number(efl),
                number(abs(first.working_f_number), 3),
                f"{number(edge)}{where.field_unit}",
                number(distance),
                number(first.total_track),
                "" if there.temperature is None else number(there.temperature),
                *map(number, values),
            )
        )
    heads = ("EFL (mm)", "published", "F/#", "field", "object (mm)", "track (mm)", "T (°C)", *shown)
    rows = zip(heads, *columns, strict=True)
    return Table(
        ("state", *lens.state_names),
        [row for row in rows if any(row[1:])],
        "The working F-number, and what states have for themselves (mm, degrees)",
    )
