"""The text of a CODE V `.seq` file is converted to a prescription.

Held: spheres, conics and aspheres, mirrors, decenters and tilts, glass by name, by code and by
private tables, circles and rectangles as apertures, and the system data.  Everything else that
bends rays is an error that names it.

Surfaces without an aperture of their own are as large as the fields need, and do not clip.
A plane in one medium that is there for its decenter or tilt becomes a coordinate break.
Remarks in front of the first command are where the lens comes from.
A file that does not say `RDM` gives curvatures, as CODE V then takes them.
`PIM`, the paraxial image solve, sets the last gap: where the file has no value for it, or one that
another last surface had, it is computed.
"""

from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.materials import index_model, parse_material
from dolens.prescriptions.codev.file import Block, opening_remarks, parse_codev
from dolens.prescriptions.codev.glass import read_glass
from dolens.prescriptions.codev.placement import (
    Axes,
    has_apertures,
    read_apertures,
    summed,
)
from dolens.prescriptions.codev.surface import (
    Surface,
    conic_constant,
    curvature_row,
    object_shape,
    read_surface,
    shape_is_given,
)
from dolens.prescriptions.codev.system import (
    factor_to_mm,
    passed_over,
    read_system,
    require_first_position,
)
from dolens.prescriptions.numbers import exact, nearest, number_in_text
from dolens.prescriptions.other_programs import (
    D_LINE,
    ReadPrescription,
    curved_object,
    paraxial_image,
)
from dolens.prescriptions.system_data import PUPIL_KEYS

# CODE V writes 1e13, and takes any distance from here on for infinity.
_INFINITE = 1e10
# A gap of PIM within this part of the focal length is CODE V's own, found with its own glass data.
_OWN_SOLVE = 1e-3


@dataclass
class _Rows:
    """The rows of a prescription, with the gap behind each."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    gaps: list[Fraction] = field(default_factory=list)
    stop: int = 0

    def append(self, row: dict[str, Any], gap: Fraction) -> None:
        self.rows.append(row)
        self.gaps.append(gap)


def read_codev(text: str, where: str = "lens") -> ReadPrescription:
    """Read a lens from the text of a `.seq` file, and list what is passed over.

    Raises:
        InputError: one line that names `where`, the surface or line, and what is not held.
    """
    file = parse_codev(text, where)
    require_first_position(file, where)
    factor = factor_to_mm(file, where)
    target, *blocks, image = file.surfaces
    _require_curvatures(blocks, factor, where)
    distance = _object_distance(target, factor, where)
    found = read_system(file, factor, distance is not None, where)
    remarks = opening_remarks(text)
    found |= {"source": remarks} if remarks else {}
    waves = found.get("wavelengths", [D_LINE])
    used = (min(waves), max(waves))
    word = target.words[2] if len(target.words) > 2 else ""
    medium = found["object_material"] = read_glass(word, file, used, f"{where}: surface SO")
    stop = _stop(file.surfaces, where)
    surfaces, axes = [], []
    for block in blocks:
        place = f"{where}: surface {block.label}"
        surface = read_surface(block, file, medium, used, block is stop, factor, place)
        surfaces.append(surface)
        axes.append(Axes(block, factor, place))
        medium = surface.medium
    axes.append(Axes(image, factor, f"{where}: surface SI"))
    if file.solved:
        surfaces[-1] = _solved(surfaces, axes, found, distance, where)
    rows, shift = _rows(blocks, surfaces, axes, found, factor, where)
    if distance is not None:
        found["object_distance"] = summed(distance, shift, where)
    prescription = _with_sensor(found, rows, axes[-1], image, factor, where)
    shape = object_shape(target, factor, f"{where}: surface SO (the object)")
    curved = curved_object(prescription, shape, f"{where}: surface SO (the object)")
    return ReadPrescription(prescription, [*passed_over(file), *curved])


def _rows(
    blocks: list[Block],
    surfaces: list[Surface],
    axes: list[Axes],
    found: dict[str, Any],
    factor: Fraction,
    where: str,
) -> tuple[_Rows, Fraction]:
    """Return the rows, and how far the first surface is moved from the object along z."""
    rows = _Rows()
    shift = Fraction(0)
    medium = found["object_material"]
    beam = not found.keys().isdisjoint(PUPIL_KEYS)
    for block, surface, own in zip(blocks, surfaces, axes, strict=False):
        if rows.gaps:
            rows.gaps[-1] += own.shift_before
        else:
            shift = own.shift_before
        gap = surface.gap + own.shift_after
        note = {"note": surface.label} if surface.label else {}
        if medium == surface.material and _is_idle(block, surface) and own.is_single:
            rows.append((own.before or own.after or {}) | note, gap)
            continue
        if own.before is not None:
            rows.append(own.before, Fraction(0))
        place = f"{where}: surface {block.label}"
        row = surface.row | {"material": surface.material} | note
        if not (beam and surface.stop) or has_apertures(block):
            row |= read_apertures(block, factor, place)
        if surface.stop:
            rows.stop = len(rows.rows) + 1
        rows.append(row, gap if own.after is None else Fraction(0))
        if own.after is not None:
            rows.append(own.after, gap)
        medium = surface.medium
    return rows, shift


def _is_idle(block: Block, surface: Surface) -> bool:
    """Return whether a surface is a plane that neither clips nor is the stop."""
    return surface.row == {"type": "plane"} and not surface.stop and not has_apertures(block)


def _with_sensor(
    found: dict[str, Any], rows: _Rows, axes: Axes, image: Block, factor: Fraction, where: str
) -> dict[str, Any]:
    """Put the image where it is: behind the last gap and the thickness of SI, its defocus, and
    then at its own decenter and tilt.
    """
    place = f"{where}: surface SI"
    defocus = exact(image.words[1] if len(image.words) > 1 else "0", f"{place}: defocus") * factor
    rows.gaps[-1] += axes.shift_before + defocus
    if axes.before is not None:
        rows.append(axes.before, Fraction(0))
    for row, gap in zip(rows.rows[:-1], rows.gaps, strict=False):
        row["thickness"] = nearest(gap, where)
    sensor: dict[str, Any] = {"distance": nearest(rows.gaps[-1], where)}
    semi_diameter = read_apertures(image, factor, place).get("semi_diameter")
    if isinstance(semi_diameter, float):
        sensor["diameter"] = 2.0 * semi_diameter
    sensor |= curvature_row(image, factor, place)
    if shape_is_given(image) and conic_constant(image, place):
        sensor["conic"] = conic_constant(image, place)
    surfaces = {str(n): row for n, row in enumerate(rows.rows, 1)}
    return {**found, "stop": rows.stop, "surfaces": surfaces, "sensor": sensor}


def _solved(
    surfaces: list[Surface],
    axes: list[Axes],
    found: dict[str, Any],
    distance: Fraction | None,
    where: str,
) -> Surface:
    """Return the last surface with the gap that the paraxial image solve gives it."""
    last = surfaces[-1]
    for surface in surfaces:
        if surface.row["type"] == "xy_polynomial" or "phase" in surface.row:
            if not last.gap:
                raise InputError(
                    f"{where}: PIM: the paraxial image behind a phase or a polynomial in x and y "
                    "is not computed, and no value is written"
                )
            return last
    model = index_model("dfc")
    wavelength = found.get("reference_wavelength", D_LINE)
    sense, indices = 1.0, []
    media = [found["object_material"], *(surface.medium for surface in surfaces)]
    mirrors = [False, *(surface.material == "mirror" for surface in surfaces)]
    for medium, mirror in zip(media, mirrors, strict=True):
        sense = -sense if mirror else sense
        try:
            indices.append(sense * float(parse_material(medium, model).index(wavelength)))
        except InputError as error:
            raise InputError(f"{where}: PIM: {error}") from None
    gaps = [
        float(surface.gap + own.shift_after + following.shift_before)
        for surface, own, following in zip(surfaces, axes, axes[1:], strict=False)
    ]
    start = None if distance is None else float(distance + axes[0].shift_before)
    place = f"{where}: PIM"
    curvatures = [surface.curvature for surface in surfaces]
    solved = paraxial_image(curvatures, gaps[:-1], indices, start, place)
    near = _OWN_SOLVE * abs(solved.focal_length)
    if last.gap and abs(float(last.gap) - solved.distance) <= near:
        return last
    return replace(last, gap=Fraction(solved.distance))


def _object_distance(target: Block, factor: Fraction, where: str) -> Fraction | None:
    """Return the distance of the object in mm, or None for infinity."""
    place = f"{where}: surface SO (the object)"
    own = Axes(target, factor, place)
    if own.before or own.after or own.shift_before:
        raise InputError(f"{place}: a decentred or tilted object is not held")
    words = target.words[1:2]
    thickness = target.commands.get("THI")
    if thickness and thickness[-1].words:
        words = thickness[-1].words[:1]
    if not words or words[0].lower() in ("inf", "infinity"):
        return None
    value = number_in_text(words[0], f"{place}: thickness")
    return None if abs(value) >= _INFINITE else exact(words[0], place) * factor


def _stop(blocks: list[Block], where: str) -> Block:
    """Return the stop: the surface that says STO, the first unless one does."""
    stops = [block for block in blocks if "STO" in block.commands]
    if len(stops) > 1:
        names = " and ".join(block.label for block in stops)
        raise InputError(f"{where}: {names} are both the stop (STO)")
    if stops and stops[0].label in ("SO", "SI"):
        raise InputError(f"{where}: {stops[0].label} cannot be the stop (STO)")
    return stops[0] if stops else blocks[1]


def _require_curvatures(blocks: list[Block], factor: Fraction, where: str) -> None:
    """Refuse a file without RDM whose numbers can hardly be the curvatures that CODE V takes."""
    for block in blocks:
        word = block.words[0] if block.words else "0"
        if block.radii is None and word.lower() not in ("inf", "infinity"):
            value = number_in_text(word, f"{where}: surface {block.label}")
            if abs(value) > 1.0:
                raise InputError(
                    f"{where}: surface {block.label}: {word} would be a curvature, as the file "
                    f"does not say RDM: a radius of {1.0 / value:.3g}; write RDM in front of the "
                    "surfaces if it gives radii, RDM N if it gives curvatures"
                )
