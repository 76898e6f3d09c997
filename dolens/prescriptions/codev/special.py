"""Special surfaces and diffractive phases of CODE V surfaces.

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
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.codev.file import Block
from dolens.prescriptions.decimals import number_in_text, scaled

_POWER = re.compile(r"a[1-9]\d*")
_FORBES = re.compile(r"q[0-9]+")
_NUMBER = re.compile(r"C([1-9]\d?)")
# Coefficients of x, y, x², ..., y¹⁰: number 1 is the conic constant.
_XY_DEGREE = 10
_HELD = ("XYP", "QBF", "ODD")
_ODD_POWERS = 30
_ODD_NORM = 33
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


def special_shape(
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
    words = block.commands["SPS"][-1].words
    kind = words[0].upper() if words else ""
    if kind not in _HELD:
        what = _NAMES.get(kind, "a special surface")
        raise InputError(f"{place}: {what} is not held (SPS {kind})".rstrip())
    texts = _coefficients(block, "SCO", f"{place}: SCO", named=kind == "ODD")
    if kind == "ODD":
        return _odd(texts, words[1:], size, factor, place)
    if kind == "QBF":
        return _forbes(texts, size, factor, place)
    if size:
        raise InputError(
            f"{place}: a polynomial in x and y on a curved surface is not held (SPS XYP)"
        )
    row: dict[str, Any] = {"type": "xy_polynomial"}
    for number, text in sorted(texts.items()):
        powers = xy_powers(number)
        if number > 1 and powers is None and number_in_text(text, place):
            raise InputError(f"{place}: SCO C{number} of SPS XYP is not held")
        if number > 1 and powers is not None:
            value = scaled(text, factor ** (1 - sum(powers)), f"{place}: SCO C{number}")
            row |= {_monomial(*powers): value} if value or text == "0" else {}
    return row


def xy_powers(number: int) -> tuple[int, int] | None:
    """Return the powers m of x and n of y of a coefficient: ((m + n)² + m + 3n)/2 + 1 = number."""
    for degree in range(1, _XY_DEGREE + 1):
        for n in range(degree + 1):
            m = degree - n
            if (degree * degree + m + 3 * n) // 2 + 1 == number:
                return m, n
    return None


def phase_row(block: Block, factor: Fraction, place: str) -> dict[str, Any]:
    """Return the phase of a surface as a prescription's row has it; empty where it has none.

    Raises:
        InputError: the phase is no radial one.
    """
    if "DIF" not in block.commands:
        return {}
    words = block.commands["DIF"][-1].words
    form = [word.upper() for word in (_words(block, "HCT") or ["R"])]
    if [word.upper() for word in words[:1]] != ["DOE"] or form != ["R"]:
        shown = " ".join([*words[:1], *form]).upper()
        raise InputError(
            f"{place}: a diffractive surface of this kind is not held (DIF {shown}; allowed: a "
            "radial phase, DIF DOE with HCT R)"
        )
    order = number_in_text((_words(block, "HOR") or ["1"])[0], f"{place}: HOR")
    if order != int(order):
        raise InputError(f"{place}: HOR must be a whole number, not {order:g}")
    waves = _words(block, "HWL")
    if not waves or number_in_text(waves[0], f"{place}: HWL") <= 0.0:
        raise InputError(f"{place}: the phase needs its wavelength (HWL, nm)")
    radians = 2.0 * math.pi / (float(waves[0]) * _NM)
    row: dict[str, Any] = {"type": "radial", "order": int(order)}
    for number, text in sorted(_coefficients(block, "HCO", f"{place}: HCO").items()):
        value = scaled(text, factor ** (1 - 2 * number), f"{place}: HCO C{number}")
        row[f"p{2 * number}"] = radians * value
    return {"phase": row}


def special_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines that `special_shape` reads back; a coefficient that is zero has no point.

    Raises:
        InputError: a coefficient has no place in CODE V's numbering.
    """
    if row["type"] == "q_bfs":
        numbers = {1: row.get("normalization_radius")}
        numbers |= {int(key[1:]) + 3: row[key] for key in row if _FORBES.fullmatch(key)}
        return ["  SPS QBF", *_lines(numbers, place)]
    if row["type"] == "odd_asphere":
        powers = {int(key[1:]): row[key] for key in row if _POWER.fullmatch(key)}
        if max(powers, default=0) > _ODD_POWERS:
            raise InputError(
                f"{place}: a .seq file cannot hold 'a{max(powers)}' of an odd asphere (allowed: a1 "
                f"to a{_ODD_POWERS})"
            )
        numbers = {1: row.get("conic", 0.0)} | {n + 1: value for n, value in powers.items()}
        return ["  SPS ODD", *_lines(numbers, place)]
    known = {_monomial(*xy): n for n in range(2, 67) if (xy := xy_powers(n))}
    numbers = {}
    for key in row:
        if monomial_powers(key) is None:
            continue
        if key not in known:
            raise InputError(f"{place}: a .seq file cannot hold '{key}' (allowed: x, y to y10)")
        numbers[known[key]] = row[key]
    return ["  SPS XYP", *_lines(numbers, place)]


def _lines(numbers: Mapping[int, Any], place: str) -> list[str]:
    values = {n: as_number(value, place) for n, value in sorted(numbers.items())}
    return [f"  SCO C{n} {value!r}" if value else f"  SCO C{n} 0" for n, value in values.items()]


def _forbes(
    texts: dict[int, str], size: dict[str, float], factor: Fraction, place: str
) -> dict[str, Any]:
    """Return Q_bfs: coefficient 1 is the radius of normalisation, 3 is q0, 4 is q1, ..."""
    if number_in_text(texts.get(2, "0"), place):
        raise InputError(f"{place}: SCO C2 of SPS QBF is not held")
    radius = scaled(texts.get(1, "0"), factor, f"{place}: SCO C1")
    if radius <= 0.0:
        raise InputError(f"{place}: SPS QBF needs its radius of normalisation (SCO C1)")
    row: dict[str, Any] = {"type": "q_bfs", **(size or {"radius": math.inf})}
    for number, text in sorted(texts.items()):
        if number > 2:
            row[f"q{number - 3}"] = scaled(text, factor, f"{place}: SCO C{number}")
    return row | {"normalization_radius": radius}


def _odd(
    texts: dict[int, str], words: list[str], size: dict[str, float], factor: Fraction, place: str
) -> dict[str, Any]:
    """Return the odd asphere: coefficient 1 is the conic constant, n + 1 that of rⁿ."""
    for word in (*words, texts.get(_ODD_NORM, "0")):
        if number_in_text(word, f"{place}: SPS ODD") not in (0.0, 1.0):
            raise InputError(
                f"{place}: an odd asphere with a radius of normalisation is not held (SPS ODD "
                f"{word})"
            )
    row: dict[str, Any] = {"type": "odd_asphere", **(size or {"radius": math.inf})}
    row["conic"] = number_in_text(texts.get(1, "0"), f"{place}: SCO C1")
    for number, text in sorted(texts.items()):
        power = number - 1
        if number in (1, _ODD_NORM):
            continue
        if power > _ODD_POWERS:
            raise InputError(f"{place}: SCO C{number} of SPS ODD is not held")
        value = scaled(text, factor ** (1 - power), f"{place}: SCO C{number}")
        row |= {f"a{power}": value} if value or text == "0" else {}
    return row


def _number(name: str, named: bool) -> int | None:
    """Return the number of a coefficient; an odd asphere's may have names."""
    match = _NUMBER.fullmatch(name)
    if match is not None:
        return int(match[1])
    if named and name == "K":
        return 1
    match = _ODD_NAME.fullmatch(name) if named else None
    return None if match is None else int(match[1]) + 1


def _coefficients(block: Block, key: str, place: str, named: bool = False) -> dict[int, str]:
    """Return the texts of numbered coefficients, which may be those that have names, too."""
    found: dict[int, str] = {}
    for command in block.commands.get(key, []):
        number = _number(command.words[0].upper(), named) if command.words else None
        if number is None or len(command.words) != 2:
            raise InputError(f"{place} (line {command.at}): expected a coefficient, as C4 0.1")
        found[number] = command.words[1]
    return found


def _monomial(m: int, n: int) -> str:
    return "".join(
        letter + (str(power) if power > 1 else "")
        for letter, power in (("x", m), ("y", n))
        if power
    )


def _words(block: Block, key: str) -> list[str]:
    return block.commands[key][-1].words if key in block.commands else []
