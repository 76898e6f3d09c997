"""The text of a Zemax `.zmx` file is converted to a prescription.

Held: sequential systems of the shapes in `zemax_shapes`, glass by model (nd, Vd) or by its name
in the catalogues of GCAT (`zemax_glass`), circular and rectangular apertures and obscurations
(`zemax_apertures`), fields as angles or object heights, wavelengths, and UNIT MM, CM, IN or METER.
Everything else that bends rays is an error that names it.  What bends no ray is passed over, and
listed (`zemax_passed_over`).

Surfaces keep their numbers, but for those that the file says to ignore.  Only planes before the
image that neither refract nor clip are left out, and their gaps added to the sensor's distance.

A CLAP clips, so it gives the semi-diameter; else DIAM does.  In Zemax a DIAM without CLAP or FLAP
draws and does not clip: here it clips.  A missing or zero DIAM is an error, because ENPD and FNUM
size the beam of the axis alone, and its semi-diameters would vignette the fields.
ENPD and FNUM close the stop (see `dolens.prescriptions.system_data`), which then needs no DIAM.
"""

import math
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.read_file import ReadPrescription
from dolens.prescriptions.system_data import PUPIL_KEYS
from dolens.prescriptions.zemax import Line, ZemaxFile, parse_zemax
from dolens.prescriptions.zemax_apertures import is_fixed, read_apertures
from dolens.prescriptions.zemax_block import SurfaceBlock
from dolens.prescriptions.zemax_configurations import other_configurations
from dolens.prescriptions.zemax_glass import read_glass
from dolens.prescriptions.zemax_passed_over import passed_over
from dolens.prescriptions.zemax_shapes import shape_of_block
from dolens.prescriptions.zemax_system import factor_to_mm, read_system

# Zemax writes INFINITY, and takes any distance from here on for it.
_INFINITE = 1e10

Block = dict[str, list[Line]]


def prescription_from_zemax(text: str, where: str = "lens") -> dict[str, Any]:
    """Read a lens from the text of a `.zmx` file; see `read_zemax`."""
    return read_zemax(text, where).prescription


def read_zemax(text: str, where: str = "lens") -> ReadPrescription:
    """Read a lens from the text of a `.zmx` file, and list what is passed over.

    Args:
        text: the file's content, decoded (see `decode_zemax`).
        where: name in messages, usually its path.

    Returns:
        A prescription with index model `dfc`: nd, Vd and indices relative to air are Zemax's own.

    Raises:
        InputError: one line that names `where`, the surface or line, and what is allowed.
    """
    file = parse_zemax(text, where)
    if len(file.surfaces) < 3:
        raise InputError(f"{where}: needs an object, a surface and an image as SURF blocks")
    factor = factor_to_mm(file, where)
    prescription = read_system(file, factor, where)
    catalogues = [word for line in file.system.get("GCAT", []) for word in line.arguments] or None
    distance = _object(prescription, file, catalogues, factor, where)
    if distance is not None:
        prescription["object_distance"] = distance
    prescription["stop"] = 1
    pupil = not prescription.keys().isdisjoint(PUPIL_KEYS)
    rows: list[dict[str, Any]] = []
    hard: list[bool] = []
    stops = []
    before = prescription["object_material"]
    for n, lines in enumerate(file.surfaces[1:-1], 1):
        place = f"{where}: surface {n}"
        if _is_ignored(lines):
            continue
        block = SurfaceBlock(lines, factor, place, before)
        shape = shape_of_block(block)
        _refuse_own_axes(block)
        row: dict[str, Any] = {}
        clips = False
        if shape.surface:
            material = read_glass(block.words("GLAS"), catalogues, place)
            block = SurfaceBlock(lines, factor, place, before, material)
            row["material"] = before = material
        if block.stop:
            stops.append(len(rows) + 1)
        row = shape.read(block) | row
        comment = " ".join(line.text for line in lines.get("COMM", []))
        if comment:
            row["note"] = comment
        if shape.surface:
            aperture, clips = read_apertures(lines, factor, place)
            beam = block.stop and pupil
            sized = not aperture.keys().isdisjoint(("semi_diameter", "aperture"))
            if clips or not beam:
                row |= aperture
            if not sized and not beam and not _is_dummy(row, block.before):
                raise InputError(
                    f"{place}: DIAM is missing or 0; write the semi-diameter (a beam on the axis "
                    "alone, which ENPD or FNUM would give, vignettes the fields)"
                )
        row["thickness"] = block.length("DISZ")
        rows.append(row)
        hard.append(clips)
    if len(stops) != 1:
        said = [n for n, lines in enumerate(file.surfaces) if "STOP" in lines]
        raise InputError(
            f"{where}: one surface from 1 to {len(file.surfaces) - 2} must be the STOP, not "
            f"{', '.join(map(str, said)) or 'none'}"
        )
    prescription["stop"] = stops[0]
    found = _with_sensor(prescription, rows, hard, file.surfaces[-1], factor, where)
    return ReadPrescription(found, [*passed_over(file), *other_configurations(file, where)])


def _with_sensor(
    prescription: dict[str, Any],
    rows: list[dict[str, Any]],
    hard: list[bool],
    image: Block,
    factor: Fraction,
    where: str,
) -> dict[str, Any]:
    """Leave out the planes before the image that do nothing; put the image where it is."""
    place = f"{where}: surface {len(rows) + 1} (the image)"
    block = SurfaceBlock(image, factor, place)
    if block.type != "STANDARD" or block.curvature != 0.0:
        raise InputError(f"{place}: must be a plane of TYPE STANDARD")
    gaps = [rows[-1].pop("thickness")]
    while len(rows) > 1 and len(rows) != prescription["stop"] and not hard[len(rows) - 1]:
        if not _is_dummy(rows[-1], rows[-2].get("material")):
            break
        rows.pop()
        gaps.append(rows[-1].pop("thickness"))
    for n, row in enumerate(rows, 1):
        if not ("semi_diameter" in row or "aperture" in row) and n != prescription["stop"]:
            raise InputError(f"{where}: surface {n}: DIAM is missing or 0; write the semi-diameter")
    sensor = {"distance": math.fsum(gaps)}
    size = read_apertures(image, factor, place)[0].get("semi_diameter")
    if size and is_fixed(image):
        sensor["diameter"] = 2.0 * size
    surfaces = {str(n): row for n, row in enumerate(rows, 1)}
    return {**prescription, "surfaces": surfaces, "sensor": sensor}


def _object(
    prescription: dict[str, Any],
    file: ZemaxFile,
    catalogues: list[str] | None,
    factor: Fraction,
    where: str,
) -> float | None:
    """Set the medium before surface 1; return the object's distance, or None for infinity."""
    place = f"{where}: surface 0 (the object)"
    block = SurfaceBlock(file.surfaces[0], factor, place)
    if block.type != "STANDARD" or block.curvature != 0.0:
        raise InputError(f"{place}: must be a plane of TYPE STANDARD")
    prescription["object_material"] = read_glass(block.words("GLAS"), catalogues, place)
    words = block.words("DISZ")
    if not words or words[0].upper() == "INFINITY":
        return None
    distance = block.length("DISZ")
    return None if abs(distance) >= _INFINITE else distance


def _is_ignored(lines: Block) -> bool:
    """Return whether a surface is there for another configuration alone: the sixth switch of
    HIDE.
    """
    return "HIDE" in lines and lines["HIDE"][-1].arguments[5:6] == ["1"]


def _refuse_own_axes(block: SurfaceBlock) -> None:
    """Refuse the decenters and tilts that a surface has among its properties (SCBD)."""
    for line in block.lines.get("SCBD", []):
        if any(number_in_text(w, f"{block.place}: SCBD") for w in line.arguments[3:]):
            raise InputError(
                f"{block.place}: a surface with its own decenter or tilt is not held (SCBD)"
            )


def _is_dummy(row: dict[str, Any], before: str | None) -> bool:
    flat = row["type"] == "plane" or (row["type"] == "sphere" and row.get("radius") == math.inf)
    return flat and "phase" not in row and row["material"] == before
