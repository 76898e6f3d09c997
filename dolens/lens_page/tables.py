"""The tables of a lens: its prescription, first-order data, Seidel sums and spot radii."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions, field_scans, spectral_lines
from dolens.analysis.spot_diagram import AIRY, SpotDiagram
from dolens.errors import InputError
from dolens.optics.elements import POSE, TILTS
from dolens.optics.lens import Lens
from dolens.optics.materials import abbe_number, index_d
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.clear_aperture import Circle, Outline, Rectangle, Unlimited

SEIDEL_HEADS = ("S I", "S II", "S III", "S IV", "S V", "C L", "C T")
SEIDEL_NAMES = (
    *("spherical", "coma", "astigm.", "Petzval", "distort."),
    *("axial col.", "lateral col."),
)
# Parameters that have a column of their own.
_COLUMNS = ("curvature", "conic")
# Numbers of an array that a table cell may hold.
_FEW = 4


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
    """

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    caption: str = ""
    words: frozenset[int] = frozenset({0})
    total: bool = False
    lit: frozenset[int] = field(default_factory=frozenset)


def number(value: float | Tensor, digits: int = 5) -> str:
    """Return a number with so many significant digits, a true minus and the sign of infinity."""
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
        mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    sign = f"e{int(exponent):d}" if e else ""
    return (mantissa + sign).replace("-", "−")


def prescription_table(lens: Lens) -> Table:
    """Return the surfaces of a lens, one a row."""
    rows = []
    gaps = [float(gap.detach()) for gap in lens.thicknesses.values()]
    gaps.append(float(lens.sensor_distance.detach()))
    surfaces = list(lens.surfaces.items())
    conics = any(_value(surface, "conic") for _, surface in surfaces)
    more = [_further(surface) for _, surface in surfaces]
    for (n, surface), gap, medium, rest in zip(
        surfaces, gaps, lens.materials[1:], more, strict=True
    ):
        stop = " (stop)" if int(n) == lens.stop else ""
        row = [n, surface.kind.replace("_", " ") + stop, _radius(surface), number(gap, 6)]
        row += [_medium(medium.name), *_glass(medium), _aperture(surface)]
        if conics:
            row.append(number(_value(surface, "conic")) if _value(surface, "conic") else "")
        if any(more):
            row.append(rest)
        rows.append(tuple(row))
    size = number(0.5 * lens.sensor_diameter) if lens.sensor_diameter else ""
    rows.append(("", "sensor", "∞", "", "", "", "", size, *[""] * (conics + any(more))))
    heads = ("#", "type", "radius", "thickness", "medium", "nd", "Vd", "semi-diameter")
    heads += ("conic",) * conics + ("coefficients",) * any(more)
    words = {1, 4} | ({len(heads) - 1} if any(more) else set())
    return Table(
        heads,
        rows,
        "Lengths in mm; the medium is the one behind the surface.",
        frozenset(words),
        lit=frozenset({lens.stop - 1}),
    )


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
    wavelength, distance = where.reference_wavelength, where.object_distance
    first = lens.first_order(wavelength, distance)
    length = float(lens.system().vertices[-2])
    sensor = float(lens.system().vertices[-1])
    airy = AIRY * wavelength * 1e-3 * abs(float(first.working_f_number))
    rows = [
        ("effective focal length", first.efl, "mm"),
        ("back focal distance", first.bfd, "mm behind the last vertex"),
        ("front focal distance", first.ffd, "mm from the first vertex"),
        ("F-number", first.f_number, "focal length over entrance pupil"),
    ]
    if distance is not None:
        rows += [
            ("working F-number", first.working_f_number, ""),
            ("magnification", first.magnification, ""),
            ("object distance", torch.tensor(distance), "mm in front of the first vertex"),
        ]
    rows += [
        ("entrance pupil diameter", first.entrance_pupil.diameter, "mm"),
        ("entrance pupil position", first.entrance_pupil.z, "mm from the first vertex"),
        ("exit pupil diameter", first.exit_pupil.diameter, "mm"),
        ("exit pupil position", first.exit_pupil.z, "mm from the first vertex"),
        ("front principal plane", first.front_principal, "mm from the first vertex"),
        ("rear principal plane", first.rear_principal, "mm from the first vertex"),
        ("paraxial image", first.image - sensor, "mm behind the sensor"),
        ("length of the lens", length, "mm, first to last vertex"),
        ("total track", sensor, "mm, first vertex to sensor"),
        ("Airy radius", airy, "µm on the sensor"),
    ]
    return Table(
        ("first order", "value", "unit"),
        [(name, number(value, 6), unit) for name, value, unit in rows],
        f"At {wavelength:g} nm.",
        frozenset({0, 2}),
    )


@torch.no_grad()
def seidel_table(lens: Lens, where: Conditions) -> Table:
    """Return Seidel sums in wavelengths, surface by surface, and their totals.

    The field is the farthest of the lens's own, or its full field where all are on the axis.
    """
    wavelength, distance = where.reference_wavelength, where.object_distance
    try:
        edge = float(field_scans(lens, distance, count=2)[0].coordinate.abs().max())
    except InputError:
        edge = 0.0
    lines = spectral_lines(lens)
    short, long = min(lines), max(lines)
    sums = lens.seidel(edge, wavelength, distance, (short, long))
    waves = torch.stack(list(sums)).T / (1e-6 * wavelength)
    rows = [
        (str(n), *(_fixed(value) for value in row)) for n, row in enumerate(waves.tolist(), 1)
    ]
    rows.append(("total", *(_fixed(value) for value in waves.sum(0).tolist())))
    unit = where.field_unit if where.field_unit == "°" else " mm"
    posed = "  They are those of the centred lens, without poses." if lens.elements else ""
    return Table(
        ("#", *(f"{h}\n{n}" for h, n in zip(SEIDEL_HEADS, SEIDEL_NAMES, strict=True))),
        rows,
        f"In wavelengths of {wavelength:g} nm, at a field of {number(edge, 4)}{unit}; colours from "
        f"{short:g} to {long:g} nm.{posed}",
        frozenset(),
        total=True,
    )


def spot_radii_table(spots: SpotDiagram, polychromatic: bool = True) -> Table:
    """Return RMS spot radii in µm: a row for each field, a column for each wavelength."""
    many = len(spots.wavelengths) > 1 and polychromatic
    heads = ("field", *(f"{float(wave):g} nm" for wave in spots.wavelengths))
    rows = []
    for at, point in enumerate(spots.fields):
        cells = [number(1e3 * value, 4) for value in spots.rms[at].tolist()]
        if many:
            cells.append(number(1e3 * float(spots.polychromatic_rms[at]), 4))
        rows.append((field_text(point, spots.field_unit), *cells))
    airy = [number(1e3 * value, 4) for value in spots.airy_radius.tolist()]
    rows.append(("Airy radius", *airy, *[""] * many))
    caption = "RMS radii in µm about the centroid of each spot"
    caption += "; polychromatic: about that of all wavelengths together." if many else "."
    if bool(spots.rms.isnan().any()):
        caption += "  – : no light passes."
    return Table(heads + ("polychromatic",) * many, rows, caption, total=True)


def field_text(point: Sequence[float] | Tensor, unit: str) -> str:
    """Return a field as text: `14°`, `(3, 14)°`, `−2 mm`."""
    x, y = (number(value, 6) for value in point)
    space = "" if unit == "°" else " "
    return f"{y}{space}{unit}" if x == "0" else f"({x}, {y}){space}{unit}"


def _fixed(value: float) -> str:
    """Return a Seidel sum with four decimals at most, aligned by its point."""
    text = f"{value:.4f}" if abs(value) < 1e3 else f"{value:.1f}"
    return text.replace("-", "−") if float(text) else "0"


def _value(surface: Surface, name: str) -> float:
    parameters = dict(surface.named_parameters())
    return float(parameters[name].detach()) if name in parameters else 0.0


def _radius(surface: Surface) -> str:
    curvature = _value(surface, "curvature")
    return "∞" if curvature == 0.0 else number(1.0 / curvature, 6)


def _further(surface: Surface) -> str:
    """Return the parameters beyond radius and conic that are not zero."""
    found = []
    for name, value in surface.named_parameters():
        if name in _COLUMNS:
            continue
        if value.numel() > _FEW:
            found.append(f"{name}: {' × '.join(map(str, value.shape))} numbers")
        elif bool((value != 0.0).any()):
            numbers = ", ".join(number(entry) for entry in value.detach().flatten().tolist())
            found.append(f"{name} {numbers}")
    return ", ".join(found)


def _aperture(surface: Surface) -> str:
    inner = surface.aperture.obscuration
    return _outline(surface.aperture.edge) + (f", obscured {_outline(inner)}" if inner else "")


def _outline(outline: Outline) -> str:
    match outline:
        case Rectangle():
            return f"{number(outline.half_width_x)} × {number(outline.half_width_y)}"
        case Unlimited():
            return f"({number(outline.semi_diameter)}, does not clip)"
        case Circle():
            return number(outline.semi_diameter)


def _medium(name: str) -> str:
    return "air" if name == "occluder" else name


def _glass(medium: object) -> tuple[str, str]:
    if medium.name in ("air", "occluder"):
        return "", ""
    vd = abbe_number(medium)
    return f"{index_d(medium):.5f}", "" if math.isinf(vd) else f"{vd:.2f}"
