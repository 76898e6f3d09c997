"""The shape and the medium of a CODE V surface are read from its block."""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.codev.file import Block, CodeVFile
from dolens.prescriptions.codev.glass import read_glass
from dolens.prescriptions.codev.special import phase_row, special_shape
from dolens.prescriptions.codev.text import unquoted
from dolens.prescriptions.decimals import (
    curvature_in_text,
    exact,
    number_in_text,
    radius_of,
    scaled,
)

# Coefficients of r⁴, r⁶, ..., r²⁰.
_COEFFICIENTS = {key: 2 * i for i, key in enumerate("ABCDEFGHJ", 2)}
_MIRRORS = ("REFL",)
_REFRACTS = ("REFR", "AIR", "")


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
    size = _curvature(block, factor, place)
    phase = phase_row(block, factor, place)
    row = _shape(block, size, stop and material == before and not phase, factor, place) | phase
    slb = block.commands.get("SLB")
    label = " ".join(map(unquoted, slb[-1].words)).strip() if slb else ""
    curvature = row.get("curvature", 1.0 / row["radius"] if row.get("radius") else 0.0)
    gap = exact(_value(block, "THI", 1), f"{place}: THI") * factor
    if not gap and _is_solved(block, "THI"):
        raise InputError(f"{place}: its gap is left to a solve (THI), and none is written")
    return Surface(row, curvature, gap, material, medium, stop, label)


def curvature_row(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Return radius or curvature as a prescription's row has it; empty for a plane."""
    return _curvature(block, factor, place)


def object_shape(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return the shape of an object as a prescription's row has it."""
    return _shape(block, _curvature(block, factor, place), False, factor, place)


def shape_is_given(block: Block) -> bool:
    """Return whether a block names a shape or coefficients."""
    return any(key in block.commands for key in ("SPH", "CON", "ASP", "K", "SPS", *_COEFFICIENTS))


def conic_constant(block: Block, place: str) -> float:
    """Return the conic constant of a block, zero where it names none."""
    return number_in_text((_words(block, "K") or ["0"])[0], f"{place}: K")


def _curvature(block: Block, factor: Fraction, place: str) -> dict[str, float]:
    """Read the first number of S, or RDY or CUY; zero is a plane."""
    if _numeric(block, "CUY"):
        value = scaled(_words(block, "CUY")[0], 1 / factor, f"{place}: CUY")
        return _curvature_row(value)
    if _numeric(block, "RDY"):
        return _radius_row(_words(block, "RDY")[0], factor, place)
    word = block.words[0] if block.words else "0"
    if word.lower() in ("inf", "infinity"):
        return {}
    if block.radii:
        return _radius_row(word, factor, place)
    return _curvature_row(scaled(word, 1 / factor, f"{place}: curvature"))


def _radius_row(word: str, factor: Fraction, place: str) -> dict[str, float]:
    radius = scaled(word, factor, f"{place}: radius")
    if radius == 0.0:
        return {}
    if factor == 1:
        curvature = curvature_in_text(word, f"{place}: radius")
        if curvature is not None:
            return {"curvature": curvature}
    return {"radius": radius}


def _curvature_row(value: float) -> dict[str, float]:
    if value == 0.0:
        return {}
    radius = radius_of(value)
    return {"curvature": value} if radius is None else {"radius": radius}


def _shape(
    block: Block, size: dict[str, float], aperture: bool, factor: Fraction, place: str
) -> dict[str, Any]:
    """Return type, radius, conic constant and coefficients."""
    if any(exact(word, f"{place}: CUF") for word in _words(block, "CUF")):
        raise InputError(f"{place}: a Fresnel surface is not held (CUF)")
    if "SPS" in block.commands:
        return special_shape(block, size, factor, place)
    if "ASP" in block.commands or any(key in block.commands for key in _COEFFICIENTS):
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
    found: dict[str, float] = {}
    used = 0
    for key, power in _COEFFICIENTS.items():
        words = _words(block, key)
        if words:
            value = scaled(words[0], factor ** (1 - power), f"{place}: {key}")
            found[f"a{power}"] = value
            used = power if value or words[0] == "0" else used
    return {name: value for name, value in found.items() if int(name[1:]) <= used}


def _material(
    block: Block, file: CodeVFile, before: str, used: tuple[float, float], place: str
) -> str:
    """Return the medium behind a surface, or `mirror`."""
    words = _words(block, "GLA") or block.words[2:3]
    mode = (_words(block, "RMD") or block.words[3:4] or [""])[0].upper()
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


def _words(block: Block, key: str) -> list[str]:
    if key in ("CUY", "RDY") and key in block.commands:
        return next(c.words for c in reversed(block.commands[key]) if _is_number(c.words))
    return block.commands[key][-1].words if key in block.commands else []
