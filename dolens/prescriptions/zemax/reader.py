"""The text of a Zemax `.zmx` file is converted to a prescription.

Held: sequential systems of the shapes in `shapes`, glass by model (nd, Vd) or by its name
in the catalogues of GCAT (`glass`), coatings of a coating file (`coatings`), circular and
rectangular apertures and obscurations (`apertures`), fields and wavelengths with their weights
(`system`), and UNIT MM, CM, IN or METER.
Everything else that bends rays is an error that names it.  What bends no ray is passed over, and
listed (`passed_over`).

Surfaces keep their numbers, but for those that the file says to ignore, and behind one that has a
tilt or decenter of its own, which becomes coordinate breaks around it.  Only planes before the
image that neither refract nor clip are left out, and their gaps added to the sensor's distance.

As in Zemax, apertures clip (CLAP, SQAP, and FLAP at a DIAM of the user's own), and a DIAM alone
draws and clips nothing.  ENPD, FNUM and OBNA close the stop (see
`dolens.prescriptions.system_data`); with FLOA its DIAM does.

A surface's own decenters and tilts are a coordinate break in front of it, and another between it
and its thickness::

    SCBD 1 order 0 dx dy tx ty tz       # before the surface
    SCBD 2 order status dx dy tx ty tz  # after it

As of a break, order 0 decentres and then turns about x, y and z, any other turns about z, y and x
first.  The status says where the numbers after the surface come from: 0 they are its own, 1 they
are those before it, 2 those undo them, with their signs and the order reversed; from 3 on they are
those of another surface.  Zemax writes the resulting numbers in each case.  SCBD 3 says of a
coordinate break that it returns to an earlier surface, and its numbers stand in PARM.

Source: OpticStudio's help, "Tilt/Decenter" (surface properties).  Files agree: a fold mirror of 45°
has the same 45° after it with status 1, and a surface turned by 90° about z, -90° with status 2 and
the other order.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

from dolens.errors import InputError
from dolens.optics.materials import MIRROR
from dolens.optics.surfaces.coordinate_break import BREAK, DECENTERS
from dolens.prescriptions.apertures import AUTOMATIC
from dolens.prescriptions.numbers import number_in_text, radius_row, scaled
from dolens.prescriptions.other_programs import D_LINE, ReadPrescription, curved_object
from dolens.prescriptions.row_data import BREAK_KIND
from dolens.prescriptions.states import STATES_KEY
from dolens.prescriptions.system_data import PUPIL_KEYS
from dolens.prescriptions.zemax.apertures import is_fixed, read_apertures
from dolens.prescriptions.zemax.coatings import Coatings
from dolens.prescriptions.zemax.configurations import read_configurations
from dolens.prescriptions.zemax.file import (
    Line,
    SurfaceBlock,
    ZemaxFile,
    parse_zemax,
)
from dolens.prescriptions.zemax.glass import read_glass
from dolens.prescriptions.zemax.gradients import gradient_medium
from dolens.prescriptions.zemax.passed_over import passed_over
from dolens.prescriptions.zemax.shapes import shape_of_block
from dolens.prescriptions.zemax.system import factor_to_mm, read_system, refuse_own_air
from dolens.prescriptions.zemax.table import Row

_BEFORE, _AFTER, _RETURN = "1", "2", "3"
_SAME, _REVERSED = 1.0, 2.0
# Behind the kind: order and status.
_NUMBERS = 3
# Zemax writes INFINITY, and takes any distance from here on for it.
_INFINITE = 1e10
GlassReader = Callable[..., str]
Block = Mapping[str, list[Line]]


def _own_axes(block: SurfaceBlock) -> tuple[Row | None, Row | None]:
    """Return the rows of the breaks before and after a surface, None where nothing moves.

    Raises:
        InputError: a coordinate break has any, or the numbers after a surface are not those that
            its status says.
    """
    before, after, status = None, None, 0.0
    for line in block.lines.get("SCBD", []):
        place = f"{block.place}: SCBD (line {line.at})"
        kind = (line.arguments or [""])[0]
        if kind == _RETURN:
            continue
        row = _axes_row(block, line.arguments, place)
        if kind == _BEFORE:
            before = row
        elif kind == _AFTER:
            after = row
            status = number_in_text((*line.arguments, "0", "0", "0")[2], place)
        elif row is not None:
            raise InputError(f"{place}: kind {kind} is not known (allowed: 1, 2, 3)")
    if block.type == "COORDBRK" and (before or after):
        raise InputError(f"{block.place}: a coordinate break with axes of its own is not held")
    sign = {_SAME: 1.0, _REVERSED: -1.0}.get(status)
    if sign and _numbers(after) != {n: sign * v for n, v in _numbers(before).items()}:
        raise InputError(
            f"{block.place}: SCBD: the tilts and decenters after the surface are not those before "
            f"it{', reversed' if status == _REVERSED else ''}, as the file says they are"
        )
    return before, after


def _axes_row(block: SurfaceBlock, words: list[str], place: str) -> Row | None:
    """Return the numbers of a break that are not zero; None where all are."""
    row: Row = {"type": BREAK_KIND}
    for name, word in zip(BREAK, words[_NUMBERS:], strict=False):
        value = (
            scaled(word, block.factor, place) if name in DECENTERS else number_in_text(word, place)
        )
        if value:
            row[name] = value
    if len(row) == 1:
        return None
    if number_in_text((*words, "0", "0")[1], place):
        row["order"] = "tilt_first"
    return row


def _numbers(row: Row | None) -> dict[str, float]:
    return {name: row[name] for name in BREAK if name in row} if row else {}


def prescription_from_zemax(text: str, where: str = "lens") -> dict[str, Any]:
    """Read a lens from the text of a `.zmx` file; see `read_zemax`."""
    return read_zemax(text, where).prescription


def read_zemax(text: str, where: str = "lens") -> ReadPrescription:
    """Read a lens from the text of a `.zmx` file, and list what is passed over.

    Args:
        text: the file's content, decoded (see `dolens.files`).
        where: name in messages, usually its path.

    Returns:
        A prescription with index model `dfc`: nd, Vd and indices relative to air are Zemax's own.

    Raises:
        InputError: one line that names `where`, the surface or line, and what is allowed.
    """
    file = parse_zemax(text, where)
    if len(file.surfaces) < 3:
        raise InputError(f"{where}: needs an object, a surface and an image as SURF blocks")
    coatings = Coatings(file, where)
    read = partial(_current, glass=_glass_reader(file), coatings=coatings, where=where)
    found = read(file)
    states, lost = read_configurations(file, found, read, where)
    if states:
        found[STATES_KEY] = states
    curved = _curved_object(file, found, factor_to_mm(file, where), where)
    return ReadPrescription(found, [*passed_over(file), *coatings.passed_over(), *curved, *lost])


def _current(file: ZemaxFile, glass: GlassReader, coatings: Coatings, where: str) -> dict[str, Any]:
    """Return the prescription of the current configuration."""
    factor = factor_to_mm(file, where)
    medium, distance = _object(file, glass, factor, where)
    prescription = read_system(file, factor, distance is not None, where)
    _curved_object(file, {**prescription, "object_distance": distance}, factor, where)
    refuse_own_air(file, where)
    prescription["stop"] = 1
    prescription["object_material"] = medium
    prescription |= coatings.common()
    primary = prescription.get("reference_wavelength", D_LINE)
    waves = [primary, *prescription.get("wavelengths", [])]
    coating = partial(coatings.row, waves=waves)
    pupil = not prescription.keys().isdisjoint(PUPIL_KEYS)
    rows, hard, stops = [], [], []
    for n, lines in enumerate(file.surfaces[1:-1], 1):
        if _is_ignored(lines):
            continue
        block = SurfaceBlock(lines, factor, f"{where}: surface {n}", medium)
        row, clips = _row(block, glass, coating, pupil)
        before, after = _own_axes(block)
        # Behind a mirror, and behind a coordinate break, is the medium in front of it.
        if row.get("material", MIRROR.name) != MIRROR.name:
            medium = row["material"]
        if before is not None:
            rows.append(before | {"thickness": 0.0})
            hard.append(False)
        rows.append(row)
        hard.append(clips)
        if block.stop and row["type"] == BREAK_KIND:
            rows.append(_stop_behind(row, block.place, medium, pupil))
            hard.append(False)
        if block.stop:
            stops.append(len(rows))
        if after is not None:
            rows.append(after | {"thickness": row["thickness"]})
            hard.append(False)
            row["thickness"] = 0.0
    if len(stops) != 1:
        said = [n for n, lines in enumerate(file.surfaces) if "STOP" in lines]
        raise InputError(
            f"{where}: one surface from 1 to {len(file.surfaces) - 2} must be the STOP, not "
            f"{', '.join(map(str, said)) or 'none'}"
        )
    prescription["stop"] = stops[0]
    if distance is not None:
        prescription["object_distance"] = _in_front(distance, prescription, rows, hard)
    return _with_sensor(prescription, rows, hard, file.surfaces[-1], factor, where)


def _glass_reader(file: ZemaxFile) -> GlassReader:
    """Return what reads a surface's glass, given the words of its GLAS and its name in messages.

    What it has read it knows, so that other configurations say nothing of it once more.
    """
    catalogues = [word for line in file.system.get("GCAT", []) for word in line.arguments]
    words = [lines["GLAS"][-1].arguments if "GLAS" in lines else [] for lines in file.surfaces]
    read = partial(read_glass, catalogues=catalogues or None, surfaces=words)
    known: dict[tuple[str, ...], str] = {}

    def glass(words: list[str], place: str) -> str:
        key = (place, *words)
        if key not in known:
            known[key] = read(words, place=place)
        return known[key]

    return glass


def _row(
    block: SurfaceBlock, glass: GlassReader, coating: Callable[..., Row], pupil: bool
) -> tuple[Row, bool]:
    """Return the row of a surface, and whether its aperture stops light.

    Args:
        block: its lines.
        glass: reads the words of GLAS.
        coating: reads COAT.
        pupil: whether the file gives the pupil, which then sizes the stop.
    """
    shape = shape_of_block(block)
    row: Row = {}
    aperture: Row = {}
    clips = False
    if shape.surface:
        material = gradient_medium(block) or glass(block.words("GLAS"), place=block.place)
        block = replace(block, material=material)
        row |= {"material": material, **coating(block)}
        sizing = block.stop and not pupil
        aperture, clips = read_apertures(block.lines, block.factor, block.place, sizing)
        if block.stop and not aperture.get("clips", True):
            aperture = {key: aperture[key] for key in aperture.keys() - {"semi_diameter", "clips"}}
        if block.stop and aperture.get("semi_diameter") == AUTOMATIC:
            del aperture["semi_diameter"]
        if sizing and aperture.keys().isdisjoint(("semi_diameter", "aperture")):
            raise InputError(
                f"{block.place}: the stop has no size: neither its DIAM nor the system's aperture "
                "(ENPD, FNUM, OBNA) gives one"
            )
    row = shape.read(block) | row
    comment = " ".join(line.text for line in block.lines.get("COMM", []))
    if comment:
        row["note"] = comment
    return row | aperture | {"thickness": block.length("DISZ")}, clips


def _stop_behind(row: Row, place: str, medium: str, pupil: bool) -> Row:
    """Return the plane of a stop that stands on a coordinate break.

    A break that only turns about z leaves the plane of the stop, and its circle, where they are.

    Raises:
        InputError: the break does more, or the stop has no size.
    """
    moves = [name for name in BREAK if name != "tilt_z" and row.get(name)]
    if moves:
        raise InputError(
            f"{place}: a stop on a coordinate break that decentres or tilts the axis is not held "
            f"({', '.join(moves)}; allowed: a turn about z)"
        )
    if not pupil:
        raise InputError(f"{place}: the stop, a coordinate break, has no size (ENPD, FNUM, OBNA)")
    stop = {"type": "aperture", "material": medium, "thickness": row["thickness"]}
    row["thickness"] = 0.0
    return stop


def _in_front(
    distance: float, prescription: dict[str, Any], rows: list[Row], hard: list[bool]
) -> float:
    """Return the distance (mm) of the object, after the planes that do nothing are left out where
    the object lies on one of them or behind it.
    """
    while distance <= 0.0 and prescription["stop"] > 1 and not hard[0]:
        if not _is_dummy(rows[0], prescription["object_material"]):
            break
        distance += rows.pop(0)["thickness"]
        hard.pop(0)
        prescription["stop"] -= 1
    return distance


def _with_sensor(
    prescription: dict[str, Any],
    rows: list[Row],
    hard: list[bool],
    image: Block,
    factor: Fraction,
    where: str,
) -> dict[str, Any]:
    """Leave out the planes before the image that do nothing; put the image where it is."""
    place = f"{where}: the image"
    block = SurfaceBlock(image, factor, place)
    shape = _image_shape(block)
    gaps = [rows[-1].pop("thickness")]
    while len(rows) > 1 and len(rows) != prescription["stop"] and not hard[len(rows) - 1]:
        if not _is_dummy(rows[-1], _medium_behind(rows[:-1], prescription)):
            break
        rows.pop()
        gaps.append(rows[-1].pop("thickness"))
    before, _ = _own_axes(block)
    if before is not None:
        rows[-1]["thickness"], gaps = math.fsum(gaps), [0.0]
        rows.append(before)
    sensor = {"distance": math.fsum(gaps)}
    size = read_apertures(image, factor, place)[0].get("semi_diameter")
    if is_fixed(image) and size is not None and size != AUTOMATIC:
        sensor["diameter"] = 2.0 * size
    sensor |= shape
    surfaces = {str(n): row for n, row in enumerate(rows, 1)}
    return {**prescription, "surfaces": surfaces, "sensor": sensor}


def _image_shape(block: SurfaceBlock) -> dict[str, float]:
    """Return radius and conic constant of a curved image; nothing of a plane."""
    if block.type not in ("STANDARD", "EVENASPH"):
        raise InputError(
            f"{block.place}: an image of this shape is not held (TYPE {block.type}; allowed: "
            "a plane, sphere or conic)"
        )
    if block.type == "EVENASPH" and any(
        float(word) for slot, word in block.slots.items() if slot[:4] == "PARM"
    ):
        raise InputError(f"{block.place}: an aspheric image is not held (allowed: a conic)")
    if block.curvature == 0.0:
        return {}
    conic = block.number("CONI")
    return radius_row(block.curvature) | ({"conic": conic} if conic else {})


def _object(
    file: ZemaxFile, glass: GlassReader, factor: Fraction, where: str
) -> tuple[str, float | None]:
    """Return the medium before surface 1, and the object's distance, None for infinity."""
    place = f"{where}: the object"
    block = SurfaceBlock(file.surfaces[0], factor, place)
    if block.type != "STANDARD":
        raise InputError(f"{place}: must be a plane of TYPE STANDARD, not {block.type}")
    if any(_own_axes(block)):
        raise InputError(f"{place}: a decentred or tilted object is not held (SCBD)")
    medium = glass(block.words("GLAS"), place=place)
    words = block.words("DISZ")
    if not words or words[0].upper() == "INFINITY":
        return medium, None
    distance = block.length("DISZ")
    return medium, None if abs(distance) >= _INFINITE else distance


def _curved_object(
    file: ZemaxFile, prescription: dict[str, Any], factor: Fraction, where: str
) -> list[str]:
    """Return a sentence about an object that is no plane."""
    place = f"{where}: the object"
    block = SurfaceBlock(file.surfaces[0], factor, place)
    return curved_object(prescription, radius_row(block.curvature), place)


def _medium_behind(rows: list[dict[str, Any]], prescription: dict[str, Any]) -> str:
    """Return the medium behind the last of some rows: mirrors and breaks leave it as it is."""
    media = (row.get("material", MIRROR.name) for row in reversed(rows))
    return next((m for m in media if m != MIRROR.name), prescription["object_material"])


def _is_ignored(lines: Block) -> bool:
    """Return whether a surface is there for another configuration alone: the sixth switch of
    HIDE.
    """
    return "HIDE" in lines and lines["HIDE"][-1].arguments[5:6] == ["1"]


def _is_dummy(row: Row, before: str | None) -> bool:
    """Return whether a row is a plane between one medium and the same."""
    flat = row["type"] == "plane" or (row["type"] == "sphere" and row.get("radius") == math.inf)
    return flat and row.keys().isdisjoint(("phase", "coating")) and row["material"] == before
