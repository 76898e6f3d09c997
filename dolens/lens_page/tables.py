"""The tables of a lens: its prescription, first-order data, Seidel sums and spot radii."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.ghosts import ghosts
from dolens.analysis.paraxial_data import ABERRATIONS, first_order_numbers, seidel_sums
from dolens.analysis.spot_diagram import SpotDiagram
from dolens.optics.elements import POSE, TILTS
from dolens.optics.fields import field_label, weights_text
from dolens.optics.lens import Lens
from dolens.optics.materials import NO_GLASS
from dolens.optics.prescription_table import SurfaceRow, prescription_table
from dolens.optics.surfaces import CoordinateBreak, TiltFirstBreak
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.clear_aperture import Circle, Ellipse, Outline, Rectangle, Unlimited
from dolens.optics.surfaces.coordinate_break import BREAK
from dolens.views.ghosts import HEADINGS, NOTE, LensGhosts

# Columns of coefficients that a page and a terminal are wide enough for.
_MOST_TERMS = 6
# Rows of a table of ghosts.
_MOST_GHOSTS = 8


@dataclass(frozen=True)
class Table:
    """A `Table` holds cells as text, ready for a terminal or a page.

    Attributes:
        heads: of the columns.
        rows: cells, as many in each as there are heads.
        caption: what the numbers are, with units.
        words: the columns that hold words; they are aligned left, and numbers right.
        total: whether the last row is a total.
        lit: numbers of rows that are set apart.
        numbered: whether the first column numbers the rows.
        listed: the columns that hold lists, which may go on in further lines.
    """

    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    caption: str = ""
    words: frozenset[int] = frozenset({0})
    total: bool = False
    lit: frozenset[int] = frozenset()
    numbered: bool = False
    listed: frozenset[int] = frozenset()


def number(value: float | Tensor, digits: int = 5, zeros: bool = False) -> str:
    """Return a number with so many significant digits, a true minus and the sign of infinity.

    Args:
        value: the number.
        digits: how many.
        zeros: whether zeros at its end stay, as they do where measured numbers stand in a column.
    """
    value = float(value)
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0.0 else "−∞"
    text = f"{value:.{digits}g}"
    mantissa, e, exponent = text.partition("e")
    if not e and abs(value) >= 1e-4:
        # As many digits for 22.000 as for 22.014, without an exponent for large numbers.
        mantissa = f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
        strip = "." in mantissa and not zeros
        mantissa = mantissa.rstrip("0").rstrip(".") if strip else mantissa
    sign = f"e{int(exponent):d}" if e else ""
    return (mantissa + sign).replace("-", "−")


def prescription_tables(lens: Lens) -> list[Table]:
    """Return the surfaces of a lens, one a row; its aspheric terms; and the poses of elements."""
    found = prescription_table(lens)
    conics = bool(found.sensor_conic) or any(row.conic for row in found.surfaces)
    # A name such as 1.5168/64.17 says nd and Vd already.
    named = any(not row.material[:1].isdigit() and _is_glass(row) for row in found.surfaces)
    rows = []
    for row, surface in zip(found.surfaces, lens.surfaces.values(), strict=True):
        cells = [str(row.number), row.kind.replace("_", " ") + " (stop)" * row.stop]
        cells += ["" if row.radius is None else number(row.radius, 6), number(row.thickness, 6)]
        cells.append("air" if row.material == "occluder" else row.material)
        if named:
            vd = "" if math.isinf(row.abbe_number) else f"{row.abbe_number:.2f}"
            cells += [f"{row.index_d:.5f}", vd] if _is_glass(row) else ["", ""]
        cells.append(_aperture(surface))
        if conics:
            cells.append(number(row.conic) if row.conic else "")
        rows.append(tuple(cells))
    size = number(0.5 * found.sensor_diameter) if found.sensor_diameter else ""
    cells = ["", "sensor", number(found.sensor_radius, 6), "", "", *[""] * (2 * named), size]
    if conics:
        cells.append(number(found.sensor_conic) if found.sensor_conic else "")
    rows.append(tuple(cells))
    heads = ("#", "type", "radius", "thickness", "medium", *("nd", "Vd") * named)
    heads += ("semi-diam.", *("conic",) * conics)
    inside = (
        [] if found.object_material == "air" else [f"The object is in {found.object_material}."]
    )
    open_ones = any(not surface.aperture.clips for surface in lens.surfaces.values())
    drawn = ["A semi-diameter in brackets clips nothing."] if open_ones else []
    first = "Lengths in mm; the medium is the one behind the surface."
    caption = " ".join([first, *drawn, *inside])
    surfaces = Table(
        heads, rows, caption, frozenset({1, 4}), lit=frozenset({lens.stop - 1}), numbered=True
    )
    more = [_terms_table(lens), breaks_table(lens), elements_table(lens)]
    return [surfaces, *(table for table in more if table is not None)]


def _terms_table(lens: Lens) -> Table | None:
    """Return coefficients beyond radius and conic, one surface a row; None where there are none."""
    found = [
        (str(row.number), row.terms)
        for row in prescription_table(lens).surfaces
        if row.terms and row.kind != CoordinateBreak.kind
    ]
    names = list(dict.fromkeys(name for _, terms in found for name in terms))
    sized = {
        n: ", ".join(
            f"{name} ({' × '.join(map(str, value.shape))})"
            for name, value in surface.named_parameters()
            if value.ndim
        )
        for n, surface in lens.surfaces.items()
    }
    sized = {n: text for n, text in sized.items() if text}
    if not found and not sized:
        return None
    if len(names) <= _MOST_TERMS and not sized:
        rows = [
            (n, *(number(terms[name]) if name in terms else "" for name in names))
            for n, terms in found
        ]
        return Table(
            ("#", *names), rows, "Coefficients, in powers of mm.", frozenset(), numbered=True
        )
    rows = []
    for n in lens.surfaces:
        terms = dict(found).get(n, {})
        texts = [f"{name}={number(value)}" for name, value in terms.items() if value]
        if n in sized:
            texts.append(sized[n])
        if terms or n in sized:
            rows.append((n, ", ".join(texts) or "all zero"))
    caption = "In powers of mm; those not named are zero."
    words = frozenset({1})
    return Table(("#", "coefficients"), rows, caption, words, numbered=True, listed=words)


def breaks_table(lens: Lens) -> Table | None:
    """Return what coordinate breaks do, one a row; None where a lens has none."""
    rows = [
        (str(row.number), *(number(row.terms[name]) for name in BREAK))
        for row in prescription_table(lens).surfaces
        if row.kind == CoordinateBreak.kind
    ]
    if not rows:
        return None
    heads = ("#", *(name.replace("_", " ") for name in BREAK))
    first = [n for n, surface in lens.surfaces.items() if isinstance(surface, TiltFirstBreak)]
    caption = "Coordinate breaks: decenters in mm, then tilts in degrees about x, y and z."
    if first:
        caption += f"  Tilts about z, y and x come first at {', '.join(first)}."
    return Table(heads, rows, caption, frozenset(), numbered=True)


def elements_table(lens: Lens) -> Table | None:
    """Return the poses of elements, one a row; None where a lens has none."""
    if not lens.elements:
        return None
    rows = []
    for name, element in lens.elements.items():
        pose = {
            key: math.degrees(value) if key in TILTS else float(value.detach())
            for key, value in element.named_parameters()
        }
        pivot = ", ".join(number(entry) for entry in element.pivot)
        cells = (number(pose[key]) for key in POSE)
        rows.append((name, f"{element.first}–{element.last}", *cells, pivot))
    heads = ("element", "surfaces", *(name.replace("_", " ") for name in POSE), "pivot")
    return Table(heads, rows, "Tilts in degrees, lengths in mm.", frozenset({0, 1}))


def first_order_table(lens: Lens, where: Conditions) -> Table:
    """Return first-order data at the reference wavelength."""
    found = first_order_numbers(lens, where)
    return Table(
        ("first order", "value", "unit"),
        [
            (quantity.name, number(quantity.value, quantity.digits), quantity.unit)
            for quantity in found.quantities()
        ],
        f"At {where.reference_wavelength:g} nm.  {found.note}".strip(),
        frozenset({0, 2}),
    )


def seidel_table(lens: Lens, where: Conditions) -> Table:
    """Return Seidel sums in wavelengths, surface by surface, and their totals."""
    found = seidel_sums(lens, where)
    waves = found.waves()
    rows = [(str(n), *(_fixed(value) for value in row)) for n, row in enumerate(waves.tolist(), 1)]
    rows.append(("total", *(_fixed(value) for value in waves.sum(0).tolist())))
    unit = where.field_unit if where.field_unit == "°" else " mm"
    posed = "  They are those of the centred lens, without poses." if lens.elements else ""
    if lens.system().breaks:
        posed = "  They are those of the lens unfolded along its axis, without tilts and decenters."
    short, long = found.colours
    return Table(
        ("#", *(f"{entry.symbol.replace('_', ' ')}\n{entry.short}" for entry in ABERRATIONS)),
        rows,
        f"In wavelengths of {found.wavelength:g} nm, at a field of {number(found.edge, 4)}{unit}; "
        f"colours from {short:g} to {long:g} nm.{posed}",
        frozenset(),
        total=True,
    )


def spot_radii_table(spots: SpotDiagram, polychromatic: bool = True) -> Table:
    """Return RMS spot radii in µm: a row for each field, a column for each wavelength."""
    many = len(spots.wavelengths) > 1 and polychromatic
    heads = ("field", *(f"{float(wave):g} nm" for wave in spots.wavelengths))
    rows = []
    for at, point in enumerate(spots.fields):
        cells = [number(1e3 * value, 4, zeros=True) for value in spots.rms[at].tolist()]
        if many:
            cells.append(number(1e3 * float(spots.polychromatic_rms[at]), 4, zeros=True))
        rows.append((field_label(point, spots.field_unit), *cells))
    airy = [number(1e3 * value, 4, zeros=True) for value in spots.airy_radius.tolist()]
    rows.append(("Airy radius", *airy, *[""] * many))
    caption = "RMS radii in µm about the centroid of each spot"
    if many:
        caption += "; polychromatic: about that of all wavelengths together"
        caption += f"{weights_text(spots.where.weights)}"
    caption += "."
    if bool(spots.rms.isnan().any()):
        caption += "  – : no light passes."
    return Table(heads + ("polychromatic",) * many, rows, caption, total=True)


def _fixed(value: float) -> str:
    """Return a Seidel sum with three decimals at most, aligned by its point."""
    text = f"{value:.3f}" if abs(value) < 1e3 else f"{value:.1f}"
    return text.replace("-", "−") if float(text) else "0"


def _aperture(surface: Surface) -> str:
    if surface.changes_axes:
        return ""
    aperture = surface.aperture
    words = [_outline(aperture.edge)]
    if aperture.window is not None:
        words.append(f"within {_outline(aperture.window)}")
    if aperture.obscuration is not None:
        words.append(f"obscured {_outline(aperture.obscuration)}")
    if any(aperture.center):
        x, y = (number(value) for value in aperture.center)
        words.append(f"about ({x}, {y})")
    return ", ".join(words)


def _outline(outline: Outline) -> str:
    match outline:
        case Rectangle():
            return f"{number(outline.half_width_x)} × {number(outline.half_width_y)}"
        case Ellipse():
            return f"ellipse {number(outline.semi_axis_x)} × {number(outline.semi_axis_y)}"
        case Unlimited():
            return f"({number(outline.semi_diameter)})"
        case Circle():
            return number(outline.semi_diameter)
        case _:
            return outline.words(number)


def _is_glass(row: SurfaceRow) -> bool:
    return row.material not in ("", *NO_GLASS)


def ghosts_of_fields(lens: Lens, where: Conditions) -> list[LensGhosts]:
    """Return the ghosts of a source at each field, at the reference wavelength.

    Raises:
        InputError: fewer than two surfaces reflect light, or none of a field enters.
    """
    at = [where.at(field[None], where.reference_wavelength) for field in where.fields]
    return [LensGhosts(lens, ghosts(lens, one)) for one in at]


def ghost_tables(found: Sequence[LensGhosts]) -> list[Table]:
    """Return a table of the brightest ghosts of each field; the last says what numbers mean."""
    tables = []
    for one in found:
        rows = one.rows(_MOST_GHOSTS)
        caption = f"{one.heading}.  {one.rest(len(rows))}"
        if one is found[-1]:
            caption += NOTE
        tables.append(Table(HEADINGS, rows, caption.strip(), frozenset({0, len(HEADINGS) - 1})))
    return tables
