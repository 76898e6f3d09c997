"""The text of an OSLO `.len` file is sorted by system and surface.

A line is a command and its arguments; `//` begins a remark.  `NXT` begins the next surface, and
`END` ends the lens.  What stands in front of the first `NXT` is about the system, but for the
surface of the object.
"""

import re
from dataclasses import dataclass, field
from typing import NamedTuple

from dolens.errors import InputError

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
POWERS = {f"A{letter}": 2 * i for i, letter in enumerate("DEFGHIJKL", 2)}
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


def parse_oslo(text: str, where: str) -> OsloFile:
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
