"""The text of a Zemax `.zmx` file is converted to a prescription.

Held: sequential systems of STANDARD and EVENASPH surfaces, glass by model (nd, Vd) or by its name
in the catalogues of GCAT (`zemax_glass`), circular and rectangular apertures and obscurations
(`zemax_apertures`), fields as angles or object heights, wavelengths, and UNIT MM, CM, IN or METER.
Everything else that bends rays is an error that says so.

CURV 0, without a decimal point, is a plane; Zemax itself writes 0.0, and that is a curvature
that an optimizer may change.  Surfaces keep their numbers.  Only planes before the image that
neither refract nor clip are left out, and their gaps added to the sensor's distance.

A CLAP clips, so it gives the semi-diameter; else DIAM does.  In Zemax a DIAM without CLAP or FLAP
draws and does not clip: here it clips.  A missing or zero DIAM is an error, because ENPD and FNUM
size the beam of the axis alone, and its semi-diameters would vignette the fields.
ENPD and FNUM close the stop (see `dolens.prescriptions.system_data`), which then needs no DIAM.
Vignetting factors, weights, ray aiming, temperature and coatings are not read.
"""

import math
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text, radius_of, scaled
from dolens.prescriptions.system_data import PUPIL_KEYS
from dolens.prescriptions.zemax import Line, ZemaxFile, parse_zemax
from dolens.prescriptions.zemax_apertures import is_fixed, read_apertures
from dolens.prescriptions.zemax_glass import read_glass
from dolens.prescriptions.zemax_system import factor_to_mm, read_system

_TYPES = ("STANDARD", "EVENASPH")
_COEFFICIENTS = 8
# Zemax writes INFINITY, and takes any distance from here on for it.
_INFINITE = 1e10

Block = dict[str, list[Line]]


def prescription_from_zemax(text: str, where: str = "lens") -> dict[str, Any]:
    """Read a lens from the text of a `.zmx` file.

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
    stops = [n for n, block in enumerate(file.surfaces) if "STOP" in block]
    if len(stops) != 1 or not 1 <= stops[0] <= len(file.surfaces) - 2:
        raise InputError(
            f"{where}: one surface from 1 to {len(file.surfaces) - 2} must be the STOP, not "
            f"{', '.join(map(str, stops)) or 'none'}"
        )
    prescription["stop"] = stops[0]
    catalogues = [word for line in file.system.get("GCAT", []) for word in line.arguments] or None
    distance = _object(prescription, file, catalogues, factor, where)
    if distance is not None:
        prescription["object_distance"] = distance
    rows, hard = [], []
    before = prescription["object_material"]
    for n, block in enumerate(file.surfaces[1:-1], 1):
        place = f"{where}: surface {n}"
        material = read_glass(_arguments(block, "GLAS"), catalogues, place)
        row = _row(block, before, material, factor, place)
        aperture, clips = read_apertures(block, factor, place)
        beam = n == stops[0] and not prescription.keys().isdisjoint(PUPIL_KEYS)
        sized = not aperture.keys().isdisjoint(("semi_diameter", "aperture"))
        if clips or not beam:
            row |= aperture
        if not sized and not beam and not _is_dummy(row, before):
            raise InputError(
                f"{place}: DIAM is missing or 0; write the semi-diameter (a beam on the axis "
                "alone, which ENPD or FNUM would give, vignettes the fields)"
            )
        row["thickness"] = _length(block, "DISZ", factor, place)
        rows.append(row)
        hard.append(clips)
        before = row["material"]
    return _with_sensor(prescription, rows, hard, file.surfaces[-1], factor, where)


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
    if _type(image, place) != "STANDARD" or _value(image, "CURV", place) != 0.0:
        raise InputError(f"{place}: must be a plane of TYPE STANDARD")
    gaps = [rows[-1].pop("thickness")]
    while len(rows) > 1 and len(rows) != prescription["stop"] and not hard[len(rows) - 1]:
        if not _is_dummy(rows[-1], rows[-2]["material"]):
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
    block, place = file.surfaces[0], f"{where}: surface 0 (the object)"
    if _type(block, place) != "STANDARD" or _value(block, "CURV", place) != 0.0:
        raise InputError(f"{place}: must be a plane of TYPE STANDARD")
    prescription["object_material"] = read_glass(_arguments(block, "GLAS"), catalogues, place)
    words = _arguments(block, "DISZ")
    if not words or words[0].upper() == "INFINITY":
        return None
    distance = _length(block, "DISZ", factor, place)
    return None if abs(distance) >= _INFINITE else distance


def _row(block: Block, before: str, material: str, factor: Fraction, place: str) -> dict[str, Any]:
    """Return type, radius, coefficients and medium of a surface between two media."""
    kind = _type(block, place)
    row: dict[str, Any] = {"type": "sphere"}
    curvature = scaled(_arguments(block, "CURV", "0")[0], 1 / factor, f"{place}: CURV")
    conic = _value(block, "CONI", place)
    coefficients = _coefficients(block, factor, place)
    if kind == "EVENASPH":
        curvature, conic = _without_square(curvature, conic, coefficients.pop("a2", 0.0), place)
        row = {"type": "even_asphere", **_curvature(curvature), "conic": conic, **coefficients}
    elif any(coefficients.values()):
        raise InputError(f"{place}: TYPE STANDARD has no PARM")
    elif "CONI" in block:
        row = {"type": "conic", **_curvature(curvature), "conic": conic}
    elif curvature == 0.0 and "STOP" in block and material == before:
        row = {"type": "aperture"}
    elif _arguments(block, "CURV", "0")[0] == "0":
        row = {"type": "plane"}
    else:
        row |= _curvature(curvature)
    comment = " ".join(line.text for line in block.get("COMM", []))
    return row | {"material": material} | ({"note": comment} if comment else {})


def _coefficients(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Return the coefficients of r², r⁴, ... by name (a2, a4, ...), in mm.

    Zemax lists all eight, used or not: then the zeros behind the last that is used are left out.
    """
    found: dict[str, float] = {}
    for line in block.get("PARM", []):
        what = f"{place}: PARM (line {line.at})"
        if len(line.arguments) < 2:
            raise InputError(f"{what}: needs a number from 1 to {_COEFFICIENTS} and a value")
        n = number_in_text(line.arguments[0], what)
        if n not in range(1, _COEFFICIENTS + 1):
            raise InputError(f"{what}: must be from 1 to {_COEFFICIENTS}, not {line.arguments[0]}")
        found[f"a{2 * int(n)}"] = scaled(line.arguments[1], factor ** (1 - 2 * int(n)), what)
    if "a2" in found:
        used = max((int(name[1:]) for name, value in found.items() if value), default=0)
        return {name: value for name, value in found.items() if int(name[1:]) <= used}
    return found


def _without_square(
    curvature: float, conic: float, square: float, place: str
) -> tuple[float, float]:
    """Return curvature and conic constant of the surface whose r² term is part of the conic.

    A paraboloid (conic -1) of curvature c is c·r²/2, as a plane is for c = 0, so a term α·r² adds
    2α to c exactly.  Any other conic plus a paraboloid is no conic.
    """
    if square == 0.0:
        return curvature, conic
    if curvature != 0.0 and conic != -1.0:
        raise InputError(
            f"{place}: PARM 1, the r² term of EVENASPH, must be 0 unless CURV is 0 or CONI is -1: "
            "it is no curvature, as the conic goes on differently"
        )
    return curvature + 2.0 * square, -1.0


def _is_dummy(row: dict[str, Any], before: str) -> bool:
    flat = row["type"] == "plane" or (row["type"] == "sphere" and row.get("radius") == math.inf)
    return flat and row["material"] == before


def _curvature(curvature: float) -> dict[str, float]:
    radius = radius_of(curvature)
    return {"curvature": curvature} if radius is None else {"radius": radius}


def _type(block: Block, place: str) -> str:
    kind = _arguments(block, "TYPE", "STANDARD")[0].upper()
    if kind not in _TYPES:
        raise InputError(f"{place}: TYPE {kind} is not held (allowed: {', '.join(_TYPES)})")
    return kind


def _length(block: Block, operand: str, factor: Fraction, place: str) -> float:
    return scaled(_arguments(block, operand, "0")[0], factor, f"{place}: {operand}")


def _value(block: Block, operand: str, place: str) -> float:
    return number_in_text(_arguments(block, operand, "0")[0], f"{place}: {operand}")


def _arguments(block: Block, operand: str, *default: str) -> list[str]:
    """Return the arguments of an operand's last line."""
    return (block[operand][-1].arguments if operand in block else []) or list(default)
