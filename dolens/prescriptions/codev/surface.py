"""The shape and the medium of a CODE V surface are read; special shapes are written, too.

`SPS XYP` adds a polynomial in x and y, `SPS ODD` all powers of r, `SPS QBF` is Forbes's Q_bfs;
`SCO C4 0.1` gives their coefficient 4.  Of `SPS ODD` coefficient 1 is the conic constant (`SCO K`)
and n + 1 that of rⁿ (`SCO ARn`), from r to r³⁰; 33 is a radius of normalisation, and 0 means none
(Lens System Setup Reference Manual).

`DIF DOE` with `HCT R` is a radial phase: the path is Σ C_i·r^2i at the wavelength HWL, in order
HOR, and φ = 2π·path/HWL.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.codev.file import Block, CodeVFile, unquoted
from dolens.prescriptions.codev.glass import read_glass
from dolens.prescriptions.numbers import (
    curvature_in_text,
    exact,
    number_in_text,
    radius_row,
    scaled,
)
from dolens.prescriptions.other_programs import (
    ALWAYS,
    Number,
    Table,
    monomials,
    powers_of_r,
    row_numbers,
    slot_values,
)

# Coefficients of an asphere, r⁴ to r²⁰.
LETTERS = powers_of_r("ABCDEFGHJ", range(4, 21, 2))
_CONIC = Number("conic", 0, ALWAYS, 0.0)
# Of an odd asphere, a radius of normalisation; 0 means none.
_ODD_NORM = "SCO C33"
_NUMBER = re.compile(r"C([1-9]\d?)")
_ODD_NAME = re.compile(r"AR([1-9]\d?)")
_NAMES = {
    "QCN": "a Forbes asphere (Q_con)",
    "ZRN": "a Zernike surface",
    "ZFR": "a Zernike surface (Fringe)",
    "SPN": "a spline surface",
    "AXI": "an axicon",
    "SUP": "a superconic surface",
    "CYL": "a cylinder",
    "UDS": "a surface of the user's own program",
}
_NM = 1e-6
_MIRRORS = ("REFL",)
_REFRACTS = ("REFR", "AIR", "")


class Special(NamedTuple):
    """A `Special` is a kind of special surface (SPS) that a prescription holds.

    Attributes:
        type: of a prescription's row.
        table: slot (`SCO C4`) → key of the row.
        curved: whether it has a radius of curvature.
        what: it is called in messages.
    """

    type: str
    table: Table
    curved: bool = True
    what: str = ""


# The order of the coefficients: Lens System Setup Reference Manual.
SPECIALS = {
    # Number 1, the conic constant, says nothing on a plane.
    "XYP": Special(
        "xy_polynomial",
        {
            f"SCO C{n}": Number(key, 1 - degree)
            for n, (key, degree) in enumerate(monomials(10).items(), 2)
        },
        curved=False,
    ),
    "QBF": Special(
        "q_bfs",
        {
            **{f"SCO C{n + 3}": Number(f"q{n}", 1) for n in range(97)},
            "SCO C1": Number("normalization_radius", 1, ALWAYS),
        },
    ),
    "ODD": Special(
        "odd_asphere",
        {"SCO C1": _CONIC, **powers_of_r((f"SCO C{n}" for n in range(2, 32)), range(1, 31))},
        what=" of an odd asphere",
    ),
}
_PHASE = {f"HCO C{n}": Number(f"p{2 * n}", 1 - 2 * n) for n in range(1, 100)}


def _special_shape(
    block: Block, size: dict[str, float], factor: Fraction, place: str
) -> dict[str, Any]:
    """Return the row of a special surface.

    Args:
        block: of the surface.
        size: radius or curvature; empty for a plane.
        factor: mm in a unit of the file.
        place: name in messages.

    Raises:
        InputError: the surface is of another kind, or a polynomial in x and y on a curved surface.
    """
    words = block.said("SPS")
    kind = words[0].upper() if words else ""
    if kind not in SPECIALS:
        what = _NAMES.get(kind, "a special surface")
        raise InputError(f"{place}: {what} is not held (SPS {kind})".rstrip())
    texts = _coefficients(block, "SCO", f"{place}: SCO", named=kind == "ODD")
    special = SPECIALS[kind]
    for word in (*words[1:], texts.pop(_ODD_NORM, "0")) if kind == "ODD" else ():
        if number_in_text(word, f"{place}: SPS ODD") not in (0.0, 1.0):
            raise InputError(
                f"{place}: an odd asphere with a radius of normalisation is not held (SPS ODD "
                f"{word})"
            )
    if size and not special.curved:
        raise InputError(
            f"{place}: a polynomial in x and y on a curved surface is not held (SPS XYP)"
        )
    for slot, text in texts.items():
        held = slot in special.table or (slot == "SCO C1" and not special.curved)
        if not held and number_in_text(text, f"{place}: {slot}"):
            raise InputError(f"{place}: {slot} of SPS {kind} is not held")
    counts = bool if kind == "QBF" else _counts
    found = row_numbers(special.table, texts, factor, place, counts)
    if kind == "QBF" and found["normalization_radius"] <= 0.0:
        raise InputError(f"{place}: SPS QBF needs its radius of normalisation (SCO C1)")
    return {"type": special.type, **(_given(size) if special.curved else {}), **found}


def special_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines that `_special_shape` reads back; nothing of another type.

    Raises:
        InputError: a coefficient has no place in CODE V's numbering.
    """
    kind = next((kind for kind, one in SPECIALS.items() if one.type == row["type"]), None)
    if kind is None:
        return []
    special = SPECIALS[kind]
    values = slot_values(special.table, row, place, ".seq", special.what)
    ordered = sorted(values, key=lambda slot: int(slot.removeprefix("SCO C")))
    return [f"  SPS {kind}", *number_lines({slot: values[slot] for slot in ordered})]


def number_lines(values: Mapping[str, float]) -> list[str]:
    """Return slots with their numbers; one that is zero is written without a point."""
    return [f"  {slot} {value!r}" if value else f"  {slot} 0" for slot, value in values.items()]


def _counts(text: str) -> bool:
    """Return whether a coefficient says anything: a writer's zero has no point."""
    return text == "0" or float(text) != 0.0


def phase_row(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return the phase of a surface as a prescription's row has it; empty where it has none.

    Raises:
        InputError: the phase is no radial one.
    """
    if "DIF" not in block.commands:
        return {}
    words = block.said("DIF")
    form = [word.upper() for word in (block.said("HCT") or ["R"])]
    if [word.upper() for word in words[:1]] != ["DOE"] or form != ["R"]:
        shown = " ".join([*words[:1], *form]).upper()
        raise InputError(
            f"{place}: a diffractive surface of this kind is not held (DIF {shown}; allowed: a "
            "radial phase, DIF DOE with HCT R)"
        )
    order = number_in_text((block.said("HOR") or ["1"])[0], f"{place}: HOR")
    if order != int(order):
        raise InputError(f"{place}: HOR must be a whole number, not {order:g}")
    waves = block.said("HWL")
    if not waves or number_in_text(waves[0], f"{place}: HWL") <= 0.0:
        raise InputError(f"{place}: the phase needs its wavelength (HWL, nm)")
    radians = 2.0 * math.pi / (float(waves[0]) * _NM)
    texts = _coefficients(block, "HCO", f"{place}: HCO")
    paths = row_numbers(_PHASE, texts, factor, place)
    phases = {key: radians * value for key, value in paths.items()}
    return {"phase": {"type": "radial", "order": int(order), **phases}}


def _coefficients(block: Block, key: str, place: str, named: bool = False) -> dict[str, str]:
    """Return the texts of numbered coefficients by their slots; those of an odd asphere may have
    names, too.
    """
    found: dict[str, str] = {}
    for command in block.commands.get(key, []):
        name = command.words[0].upper() if command.words else ""
        number, power = _NUMBER.fullmatch(name), _ODD_NAME.fullmatch(name) if named else None
        if len(command.words) != 2 or not (number or power or (named and name == "K")):
            raise InputError(f"{place} (line {command.at}): expected a coefficient, as C4 0.1")
        n = int(number[1]) if number else int(power[1]) + 1 if power else 1
        found[f"{key} C{n}"] = command.words[1]
    return found


@dataclass(frozen=True)
class Surface:
    """A `Surface` is what a block says of shape, gap and medium.

    Attributes:
        row: type, radius and coefficients as a prescription has them.
        curvature: on the axis, 1/mm.
        gap: to the next surface, mm.
        material: medium behind it as a prescription has it, or `mirror`.
        medium: in which light travels behind it.
        stop: whether it is the stop.
        label: its name, or nothing.
    """

    row: dict[str, Any]
    curvature: float
    gap: Fraction
    material: str
    medium: str
    stop: bool
    label: str


def read_surface(
    block: Block,
    file: CodeVFile,
    before: str,
    used: tuple[float, float],
    stop: bool,
    factor: Fraction,
    place: str,
) -> Surface:
    """Read a surface's block.

    Args:
        block: of the surface.
        file: with its private glasses.
        before: medium in front of the surface.
        used: shortest and longest wavelength, nm.
        stop: whether the surface is the stop.
        factor: mm in a unit of the file.
        place: name in messages.

    Raises:
        InputError: the surface is a Fresnel lens, reflects as no mirror does, or a number is none.
    """
    material = _material(block, file, before, used, place)
    medium = before if material == "mirror" else material
    size = curvature_row(block, factor, place)
    phase = phase_row(block, factor, place)
    row = _shape(block, size, stop and material == before and not phase, factor, place) | phase
    slb = block.commands.get("SLB")
    label = " ".join(map(unquoted, slb[-1].words)).strip() if slb else ""
    curvature = row.get("curvature", 1.0 / row["radius"] if row.get("radius") else 0.0)
    gap = exact(_value(block, "THI", 1), f"{place}: THI") * factor
    if not gap and _is_solved(block, "THI"):
        raise InputError(f"{place}: its gap is left to a solve (THI), and none is written")
    return Surface(row, curvature, gap, material, medium, stop, label)


def object_shape(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return the shape of an object as a prescription's row has it."""
    return _shape(block, curvature_row(block, factor, place), False, factor, place)


def shape_is_given(block: Block) -> bool:
    """Return whether a block names a shape or coefficients."""
    return any(key in block.commands for key in ("SPH", "CON", "ASP", "K", "SPS", *LETTERS))


def conic_constant(block: Block, place: str) -> float:
    """Return the conic constant of a block, zero where it names none."""
    return number_in_text((block.said("K") or ["0"])[0], f"{place}: K")


def curvature_row(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Read radius or curvature: the first number of S, or RDY or CUY; nothing of a plane."""
    if _numeric(block, "CUY"):
        value = scaled(_value(block, "CUY", 0), 1 / factor, f"{place}: CUY")
        return radius_row(value) if value else {}
    if _numeric(block, "RDY"):
        return _radius_row(_value(block, "RDY", 0), factor, place)
    word = block.words[0] if block.words else "0"
    if word.lower() in ("inf", "infinity"):
        return {}
    if block.radii:
        return _radius_row(word, factor, place)
    value = scaled(word, 1 / factor, f"{place}: curvature")
    return radius_row(value) if value else {}


def _radius_row(word: str, factor: Fraction, place: str) -> dict[str, float]:
    radius = scaled(word, factor, f"{place}: radius")
    if radius == 0.0:
        return {}
    if factor == 1:
        curvature = curvature_in_text(word, f"{place}: radius")
        if curvature is not None:
            return {"curvature": curvature}
    return {"radius": radius}


def _shape(
    block: Block, size: dict[str, float], aperture: bool, factor: Fraction, place: str
) -> dict[str, Any]:
    """Return type, radius, conic constant and coefficients."""
    if any(exact(word, f"{place}: CUF") for word in block.said("CUF")):
        raise InputError(f"{place}: a Fresnel surface is not held (CUF)")
    if "SPS" in block.commands:
        return _special_shape(block, size, factor, place)
    if "ASP" in block.commands or any(key in block.commands for key in LETTERS):
        conic = {"conic": conic_constant(block, place)}
        return {"type": "even_asphere", **_given(size), **conic} | _powers(block, factor, place)
    if "CON" in block.commands or "K" in block.commands:
        return {"type": "conic", **_given(size), "conic": conic_constant(block, place)}
    if size or "SPH" in block.commands:
        return {"type": "sphere", **_given(size)}
    return {"type": "aperture" if aperture else "plane"}


def _given(size: dict[str, float]) -> dict[str, float]:
    return size or {"radius": math.inf}


def _powers(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Return the coefficients by name, in mm.

    CODE V lists `C 0.0; D 0.0` that nobody uses: zeros with a point behind the last coefficient
    that is used are left out.
    """
    words = {key: block.said(key)[0] for key in LETTERS if block.said(key)}
    found = row_numbers(LETTERS, words, factor, place)
    used = max((n for n, key in enumerate(LETTERS) if _counts(words.get(key, "0.0"))), default=-1)
    kept = [number.key for number in islice(LETTERS.values(), used + 1)]
    return {key: found[key] for key in kept if key in found}


def _material(
    block: Block, file: CodeVFile, before: str, used: tuple[float, float], place: str
) -> str:
    """Return the medium behind a surface, or `mirror`."""
    words = block.said("GLA") or block.words[2:3]
    mode = (block.said("RMD") or block.words[3:4] or [""])[0].upper()
    glass = unquoted(words[0]) if words else ""
    if glass.upper() in _MIRRORS:
        glass, mode = "", glass.upper()
    if mode in _MIRRORS:
        if glass and read_glass(glass, file, used, place) != before:
            raise InputError(f"{place}: a mirror with another medium behind it is not held (REFL)")
        return "mirror"
    if mode not in _REFRACTS:
        raise InputError(f"{place}: {mode} (allowed: REFL for a mirror, REFR)")
    return read_glass(glass, file, used, place)


def _value(block: Block, key: str, at: int) -> str:
    """Return a number of S, or of a command that replaces it."""
    if _numeric(block, key):
        return next(c.words[0] for c in reversed(block.commands[key]) if _is_number(c.words))
    word = block.words[at] if len(block.words) > at else "0"
    return "0" if word.lower() in ("inf", "infinity") else word


def _is_solved(block: Block, key: str) -> bool:
    return any(not _is_number(command.words) for command in block.commands.get(key, []))


def _numeric(block: Block, key: str) -> bool:
    """Return whether a command gives a number, and not the solve or the pick-up that sets it."""
    return any(_is_number(command.words) for command in block.commands.get(key, []))


def _is_number(words: list[str]) -> bool:
    return bool(words) and words[0][:1] in set("+-.0123456789")
