"""Rotational polynomials in a Zemax `.zmx` file: odd aspheres, extended aspheres, Forbes's.

ODDASPHE has PARM 1 to 8, the coefficients of r to r⁸.  The extended aspheres have XDAT 1, the
number of terms, XDAT 2, a radius that r is divided by, and from XDAT 3 the coefficients: of even
powers in XASPHERE, of all powers in XOSPHERE, behind the PARM of EVENASPH.  QED_TYPE has
XDAT 1: 0 for Q_bfs and 1 for Q_con, then number of terms, normalisation radius, and from XDAT 4
the coefficients; CONI counts for both, the departure of Q_bfs being along the conic's normal.
"""

import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.even_asphere import power_of
from dolens.prescriptions.numbers import as_number, number_in_text, scaled
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import conic_line, curvature_line

_ODD_TERMS = 8
_EVEN_TERMS = 8
_MOST = 240
_FORBES_FIRST = 4
_FORBES_TERM = re.compile(r"q(0|[1-9]\d*)")


def number_of_terms(block: SurfaceBlock, place: int, most: int) -> int:
    """Return a number of terms in XDAT.

    Raises:
        InputError: it is no whole number from 0 to `most`.
    """
    count = number_in_text(block.extra_data.get(place, "0"), f"{block.place}: XDAT {place}")
    if not (0 <= count <= most and count == int(count)):
        raise InputError(
            f"{block.place}: XDAT {place} must be a number of terms from 0 to {most}, not "
            f"{block.extra_data[place]}"
        )
    return int(count)


def positive_extra(block: SurfaceBlock, place: int, what: str) -> str:
    """Return a number of XDAT as it is written.

    Raises:
        InputError: it is missing or not positive.
    """
    word = block.extra_data.get(place, "0")
    if not number_in_text(word, f"{block.place}: XDAT {place}") > 0.0:
        raise InputError(f"{block.place}: XDAT {place}, {what}, must be positive, not {word}")
    return word


def named(word: str) -> bool:
    """Return whether a coefficient counts: it is not zero, or a writer's named zero."""
    return float(word) != 0.0 or word == NAMED_ZERO


def text(value: object, place: str) -> str:
    """Return a number as a writer gives it; a coefficient that is zero is a named zero."""
    return repr(as_number(value, place) or float(NAMED_ZERO))


def power_lines(
    row: Mapping[str, Any], place: str, least: int, most: int, parameter: Callable[[int], int]
) -> list[str]:
    """Return the PARM lines of the coefficients `a…` of a row.

    Args:
        row: of a prescription.
        place: name in messages.
        least: the lowest power that the file's type holds.
        most: the highest.
        parameter: the number of the parameter of a power.

    Raises:
        InputError: a power beyond it.
    """
    lines = []
    for key in row:
        power = power_of(key)
        if power is None:
            continue
        if power > most:
            raise InputError(
                f"{place}: a .zmx file cannot hold '{key}' (allowed: a{least} to a{most})"
            )
        lines.append(f"PARM {parameter(power)} {text(row[key], place)}")
    return lines


def _base(block: SurfaceBlock, kind: str) -> Row:
    return {"type": kind, **curvature_row(block.curvature), "conic": block.number("CONI")}


def _read_odd(block: SurfaceBlock) -> Row:
    powers = [n for n in sorted(block.parameters) if n and named(block.parameters[n])]
    return _base(block, "odd_asphere") | {f"a{n}": block.parameter(n, 1 - n) for n in powers}


def _write_odd(row: Mapping[str, Any], place: str) -> list[str]:
    powers = power_lines(row, place, 1, _ODD_TERMS, lambda power: power)
    return [curvature_line(row, place), conic_line(row, place), *powers]


def _read_extended(block: SurfaceBlock, kind: str, step: int) -> Row:
    """Return an asphere whose coefficients are those of PARM plus those of XDAT, rescaled."""
    found: dict[int, Fraction] = {}
    for n in range(1, _EVEN_TERMS + 1):
        word = block.parameters.get(n, "0")
        if named(word):
            number_in_text(word, f"{block.place}: PARM {n}")
            found[2 * n] = Fraction(word) * block.factor ** (1 - 2 * n)
    count = number_of_terms(block, 1, _MOST)
    if count:
        radius = Fraction(positive_extra(block, 2, "the radius of normalization")) * block.factor
        for n in range(1, count + 1):
            word = block.extra_data.get(n + 2, "0")
            if named(word):
                # A coefficient is a length: α·(r/R)^power.
                more = Fraction(word) * block.factor / radius ** (step * n)
                found[step * n] = found.get(step * n, Fraction(0)) + more
    what = f"{block.place}: a coefficient"
    terms = {f"a{power}": scaled("1", found[power], what) if found[power] else 0.0
             for power in sorted(found)}  # fmt: skip
    return _base(block, kind) | terms


def _never(row: Mapping[str, Any], place: str) -> list[str]:
    """Refuse to write: no type of a row is written as an extended asphere."""
    raise InputError(f"{place}: extended aspheres are read only")


def _read_forbes(block: SurfaceBlock) -> Row:
    kind = number_in_text(block.extra_data.get(1, "0"), f"{block.place}: XDAT 1")
    if kind not in (0.0, 1.0):
        raise InputError(
            f"{block.place}: XDAT 1 must be 0 (Q_bfs) or 1 (Q_con), not {block.extra_data[1]}"
        )
    count = number_of_terms(block, 2, _MOST)
    positive_extra(block, 3, "the normalization radius")
    row = _base(block, "q_con" if kind else "q_bfs")
    terms = {
        f"q{n}": block.extra(n + _FORBES_FIRST, 1)
        for n in range(count)
        if named(block.extra_data.get(n + _FORBES_FIRST, "0"))
    }
    return row | {"normalization_radius": block.extra(3, 1), **terms}


def _write_forbes(row: Mapping[str, Any], place: str) -> list[str]:
    terms = {int(m[1]): value for key, value in row.items() if (m := _FORBES_TERM.fullmatch(key))}
    count = max(terms, default=-1) + 1
    if count > _MOST:
        raise InputError(f"{place}: a .zmx file cannot hold 'q{count - 1}'")
    return [
        curvature_line(row, place),
        conic_line(row, place),
        f"XDAT 1 {int(row['type'] == 'q_con')}",
        f"XDAT 2 {count}",
        f"XDAT 3 {as_number(row.get('normalization_radius'), place)!r}",
        *(f"XDAT {n + _FORBES_FIRST} {text(value, place)}" for n, value in sorted(terms.items())),
    ]


ODD_ASPHERE = ZemaxShape(
    "ODDASPHE", ("odd_asphere",), _read_odd, _write_odd, parameters=range(1, _ODD_TERMS + 1)
)
EXTENDED_ASPHERE = ZemaxShape(
    "XASPHERE",
    (),
    lambda block: _read_extended(block, "even_asphere", 2),
    _never,
    parameters=range(1, _EVEN_TERMS + 1),
    extra_data=range(1, _MOST + 3),
)
EXTENDED_ODD_ASPHERE = ZemaxShape(
    "XOSPHERE",
    (),
    lambda block: _read_extended(block, "odd_asphere", 1),
    _never,
    parameters=range(1, _EVEN_TERMS + 1),
    extra_data=range(1, _MOST + 3),
)
FORBES = ZemaxShape(
    "QED_TYPE",
    ("q_con", "q_bfs"),
    _read_forbes,
    _write_forbes,
    extra_data=range(1, _FORBES_FIRST + _MOST),
)
