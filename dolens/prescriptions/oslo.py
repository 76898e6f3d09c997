"""Lenses of OSLO (`.len`, as text) are read.

A line is a command and its arguments; `//` begins a remark.  `NXT` begins the next surface, and
`END` ends the lens.  What stands in front of the first `NXT` is about the system, but for the
surface of the object.

Held: spheres, conics and aspheres to r²⁰, mirrors, glass by name and by code, apertures, one
field at the edge, and wavelengths.  An aperture that OSLO checks (`AP CHK`) clips; the others are
drawn.  Angles and places of surfaces (`TLA`, `DCY`, ...) are refused, as are general aspheres.
The axis and the edge of the field are the fields.
"""

import math
import re
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.optics.dispersion import require_wavelengths
from dolens.prescriptions.codev.glass import glass_by_name_or_code
from dolens.prescriptions.numbers import exact, nearest, number_in_text, radius_row, scaled
from dolens.prescriptions.other_programs import (
    ReadPrescription,
    curved_object,
    image_shape,
    powers_of_r,
    row_numbers,
)
from dolens.prescriptions.system_data import unequal_weights

_LINE_END = re.compile(r"\r\n|\r|\n")
_LONGEST_LINE = 20_000
_MOST_SURFACES = 2000
_WORD = re.compile(r'"[^"]*"?|[^\s"]+')

SYSTEM = (*("LEN", "UNI", "EBR", "FNO", "NAO", "ANG", "OBH", "GIH", "WV", "WW", "PRE", "TEM"),)
SURFACE = (
    *("TH", "RD", "CV", "AP", "GLA", "AIR", "RFL", "RFH", "CC", "AST", "ASP"),
    *("DCX", "DCY", "DCZ", "TLA", "TLB", "TLC", "BEN", "RCO", "GC", "TOX", "TOY", "TOZ"),
)
# Coefficients of r⁴, r⁶, ..., r²⁰.
POWERS = powers_of_r((f"A{letter}" for letter in "DEFGHIJKL"), range(4, 21, 2))
# What bends no ray, by what it is about.
_WITHOUT_EFFECT = {
    "names and drawing": ("DES", "DRW", "LBL", "COMM"),
    "apodization": ("APO",),
    "tolerances": (
        *("DLRS", "DLAS", "DLNR", "DLMN", "DLMX", "DLHA", "DSIG", "CIGN", "SDSD", "FCC"),
    ),
    "variables of an optimization": ("VAR",),
    "expansion with temperature": ("TCE",),
    "settings of the program": ("SPE", "RAI", "RAIM", "CBK", "WARM", "AFO0", "DT"),
}
_GROUP_OF = {command: group for group, keys in _WITHOUT_EFFECT.items() for command in keys}
_REFUSED = {
    "ASP": "a general aspheric surface",
    "CVX": "a second curvature, across x",
    "RDX": "a second radius, across x",
    "GOR": "a diffraction order",
    "GSP": "a diffraction grating",
    "DOR": "a diffraction order",
    "DOE": "a diffractive surface",
    "DF0": "a diffractive surface",
    "HOR": "a hologram",
    "GDT": "a gradient index",
    "GIN": "a gradient index",
    "PFL": "a perfect lens",
    "PFM": "a perfect lens",
    "EII": "an eikonal",
    "NSS": "a group of non-sequential surfaces",
    "APN": "special apertures",
    "ATP": "a special aperture",
    "AAC": "a special aperture",
    "AX1": "a special aperture",
    "AY1": "a special aperture",
    "GRZ": "a gradient index",
    "CFG": "further configurations",
    "AFO": "an afocal image",
    "SPL": "a spline surface",
    "ZRX": "a Zernike surface",
}
_INFINITE = 1e10
_MICROMETRE = Fraction(1000)
_PLACES = ("DCX", "DCY", "DCZ", "TLA", "TLB", "TLC", "BEN", "RCO", "GC", "TOX", "TOY", "TOZ")


class Line(NamedTuple):
    """A `Line` has its number from 1, its command in capitals, and its arguments."""

    at: int
    command: str
    words: list[str]


@dataclass
class OsloFile:
    """An `OsloFile` holds the lines of a file.

    Attributes:
        system: command → its last line.
        surfaces: the same for each surface, from the object to the image.
        notes: what OSLO calls system notes, in their order.
        passed_over: what commands that bend no ray are about → these commands.
    """

    system: dict[str, Line] = field(default_factory=dict)
    surfaces: list[dict[str, Line]] = field(default_factory=lambda: [{}])
    notes: list[str] = field(default_factory=list)
    passed_over: dict[str, dict[str, None]] = field(default_factory=dict)


def _parse_oslo(text: str, where: str) -> OsloFile:
    """Sort the lines of a `.len` file.

    Raises:
        InputError: a command may bend rays and is not held or known, or the file does not begin a
            lens, or not end it.
    """
    file = OsloFile()
    begun = False
    for at, raw in enumerate(_LINE_END.split(text), 1):
        if len(raw) > _LONGEST_LINE:
            raise InputError(f"{where}: line {at} is longer than {_LONGEST_LINE} letters")
        words = _WORD.findall(raw.partition("//")[0] if '"' not in raw else raw)
        if not words or words[0].startswith("//"):
            continue
        line = Line(at, words[0].upper(), words[1:])
        if not begun:
            if line.command != "LEN":
                raise InputError(f"{where}: line {at}: expected LEN NEW, not {line.command}")
            begun = True
        if line.command == "END":
            return file
        _sort(file, line, f"{where}: line {at}")
    raise InputError(f"{where}: ends without END")


def _sort(file: OsloFile, line: Line, place: str) -> None:
    command = line.command
    if command == "NXT":
        if len(file.surfaces) > _MOST_SURFACES:
            raise InputError(f"{place}: more than {_MOST_SURFACES} surfaces")
        file.surfaces.append({})
    elif re.fullmatch(r"SNO\d*", command):
        file.notes.append(" ".join(word.strip('"') for word in line.words))
    elif command in _REFUSED:
        raise InputError(f"{place}: {_REFUSED[command]} is not held ({command})")
    elif command in SURFACE or command in POWERS:
        file.surfaces[-1][command] = line
    elif command in ("PY", "PU", "PUC", "PYC", "PI", "PIC", "EC"):
        file.surfaces[-1]["SOLVE"] = line
    elif command in SYSTEM:
        file.system[command] = line
    else:
        group = _GROUP_OF.get(command)
        if group is None:
            raise InputError(f"{place}: command {command} is not known, and may bend rays")
        file.passed_over.setdefault(group, {})[command] = None


Block = dict[str, Line]


def read_oslo(text: str, where: str) -> ReadPrescription:
    """Read a lens from the text of a `.len` file, and list what is passed over.

    Raises:
        InputError: one line that names `where`, the surface or line, and what is not held.
    """
    file = _parse_oslo(text, where)
    if len(file.surfaces) < 3:
        raise InputError(f"{where}: needs an object, a surface and an image")
    factor = _factor(file, where)
    target, *blocks, image = file.surfaces
    distance = _object_distance(target, factor, where)
    place = f"{where}: surface 0 (the object)"
    seen = {"object_distance": distance, **_field(file, factor, where)}
    curved = curved_object(seen, _shape(target, factor, place), place)
    prescription = _system(file, factor, distance is not None, where)
    medium = prescription["object_material"] = _medium(target, f"{where}: surface 0")
    if distance is not None:
        prescription["object_distance"] = distance
    stops = [n for n, block in enumerate(blocks, 1) if "AST" in block]
    if len(stops) > 1:
        raise InputError(f"{where}: surfaces {stops[0]} and {stops[1]} are both the stop (AST)")
    stop = prescription["stop"] = stops[0] if stops else 1
    found: dict[str, dict[str, Any]] = {}
    gaps = []
    beam = bool({"entrance_pupil_diameter", "f_number", "object_na"} & prescription.keys())
    for n, block in enumerate(blocks, 1):
        place = f"{where}: surface {n}"
        _refuse_places(block, place)
        material = _medium(block, place)
        row = _shape(block, factor, place)
        if row == {"type": "plane"} and n == stop and material == medium:
            row = {"type": "aperture"}
        row["material"] = material
        if not (n == stop and beam) or _clips(block):
            row |= _aperture(block, factor, place)
        gaps.append(_gap(block, factor, place))
        medium = medium if material == "mirror" else material
        found[str(n)] = row
    for row, gap in zip(list(found.values())[:-1], gaps, strict=False):
        row["thickness"] = nearest(gap, where)
    prescription["surfaces"] = found
    place = f"{where}: the image"
    _refuse_places(image, place)
    behind = _words(image, "TH")
    gap = gaps[-1] + (exact(behind[0], f"{place}: TH") * factor if behind else 0)
    prescription["sensor"] = {"distance": nearest(gap, where)} | image_shape(
        _shape(image, factor, place), place
    )
    solves = ["solves, whose values are written"] if any("SOLVE" in b for b in blocks) else []
    groups = [f"{group} ({', '.join(keys)})" for group, keys in file.passed_over.items()]
    return ReadPrescription(prescription, [*solves, *groups, *curved])


def _system(file: OsloFile, factor: Fraction, finite: bool, where: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    title = file.system["LEN"].words[1:2]
    if title and title[0].strip('"').strip():
        found["name"] = title[0].strip('"').strip()
    notes = "\n".join(note for note in file.notes if note.strip())
    if notes:
        found["source"] = notes
    found["index_model"] = "dfc"
    waves = file.system.get("WV")
    if waves:
        values = [scaled(word, _MICROMETRE, f"{where}: WV") for word in waves.words]
        require_wavelengths(values, f"{where}: WV", "µm")
        found |= {"wavelengths": values, "reference_wavelength": values[0]}
        weights = [number_in_text(w, f"{where}: WW") for w in _words(file.system, "WW")]
        found |= unequal_weights("wavelength_weights", weights, len(values), f"{where}: WW")
    for command, key, usual in (("TEM", "temperature", 20.0), ("PRE", "pressure", 1.0)):
        words = _words(file.system, command)
        if words and number_in_text(words[0], f"{where}: {command}") != usual:
            found[key] = float(words[0])
    return found | _field(file, factor, where) | _pupil(file, factor, finite, where)


def _field(file: OsloFile, factor: Fraction, where: str) -> dict[str, Any]:
    """Return the axis and the edge of the field."""
    for command, kind, unit in (
        ("ANG", "angles", Fraction(1)),
        ("OBH", "heights", factor),
        ("GIH", "image_heights", factor),
    ):
        if command in file.system:
            words = _words(file.system, command) or ["0"]
            edge = scaled(words[0], unit, f"{where}: {command}")
            if edge:
                return {"fields": {kind: [[0.0, 0.0], [0.0, edge]]}}
            return {"fields": {kind: [[0.0, 0.0]]}}
    return {}


def _pupil(file: OsloFile, factor: Fraction, finite: bool, where: str) -> dict[str, float]:
    for command in ("EBR", "NAO", "FNO"):
        if command not in file.system:
            continue
        place = f"{where}: {command}"
        word = (_words(file.system, command) or [""])[0]
        if command == "EBR":
            # The radius of the beam on the first surface: that of the entrance pupil for a far
            # object alone.
            if finite:
                raise InputError(
                    f"{place}: a beam radius on surface 1 is not held for a near object "
                    "(allowed: NAO)"
                )
            return {"entrance_pupil_diameter": scaled(word, 2 * factor, place)}
        if command == "NAO":
            return {"object_na": number_in_text(word, place)}
        return {"working_f_number" if finite else "f_number": number_in_text(word, place)}
    return {}


def _factor(file: OsloFile, where: str) -> Fraction:
    """Return millimetres in the file's unit of length."""
    words = _words(file.system, "UNI")
    factor = exact(words[0], f"{where}: UNI") if words else Fraction(1)
    if factor <= 0:
        raise InputError(f"{where}: UNI must be positive: millimetres in the unit of length")
    return factor


def _object_distance(target: Block, factor: Fraction, where: str) -> float | None:
    place = f"{where}: surface 0 (the object)"
    _refuse_places(target, place)
    words = _words(target, "TH")
    if not words or abs(number_in_text(words[0], place)) >= _INFINITE:
        return None
    return scaled(words[0], factor, place)


def _shape(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return type, radius, conic constant and coefficients."""
    size = _size(block, factor, place)
    words = {key: _words(block, key)[0] for key in POWERS if _words(block, key)}
    powers = row_numbers(POWERS, words, factor, place)
    conic = number_in_text((_words(block, "CC") or ["0"])[0], f"{place}: CC")
    if powers:
        return {"type": "even_asphere", **(size or {"radius": math.inf}), "conic": conic} | powers
    if conic:
        return {"type": "conic", **(size or {"radius": math.inf}), "conic": conic}
    return {"type": "sphere", **size} if size else {"type": "plane"}


def _size(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Return radius or curvature; nothing for a plane."""
    if "RD" in block:
        radius = scaled((_words(block, "RD") or ["0"])[0], factor, f"{place}: RD")
        return {"radius": radius} if radius else {}
    curvature = scaled((_words(block, "CV") or ["0"])[0], 1 / factor, f"{place}: CV")
    return radius_row(curvature) if curvature else {}


def _medium(block: Block, place: str) -> str:
    if "RFL" in block or "RFH" in block:
        return "mirror"
    words = _words(block, "GLA")
    if not words:
        return "air"
    if len(words) > 1:
        raise InputError(f"{place}: a glass by its own indices is not held (GLA {words[0]})")
    return glass_by_name_or_code(words[0].strip('"'), place)


def _aperture(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return the size; one that OSLO does not check does not clip, and none is as large as must
    be.
    """
    numbers = [word for word in _words(block, "AP") if word.upper() not in ("CHK", "NOP", "STD")]
    if not numbers or number_in_text(numbers[0], f"{place}: AP") == 0.0:
        return {"semi_diameter": "auto"}
    size = {"semi_diameter": scaled(numbers[0], factor, f"{place}: AP")}
    return size if _clips(block) else size | {"clips": False}


def _clips(block: Block) -> bool:
    return "CHK" in [word.upper() for word in _words(block, "AP")]


def _gap(block: Block, factor: Fraction, place: str) -> Fraction:
    words = _words(block, "TH")
    gap = exact(words[0], f"{place}: TH") * factor if words else Fraction(0)
    if not gap and "SOLVE" in block:
        raise InputError(f"{place}: its gap is left to a solve, and none is written")
    return gap


def _refuse_places(block: Block, place: str) -> None:
    """Refuse decenters and tilts that are not zero."""
    for command in _PLACES:
        if command not in block:
            continue
        words = _words(block, command)
        if not words or any(number_in_text(word, f"{place}: {command}") for word in words[:1]):
            raise InputError(f"{place}: a decentred or tilted surface is not held ({command})")


def _words(lines: dict[str, Line], command: str) -> list[str]:
    return lines[command].words if command in lines else []
