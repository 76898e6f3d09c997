"""TYPE XPOLYNOM of a Zemax `.zmx` file is a conic plus a polynomial in x and y.

XDAT 1 is the number of terms, XDAT 2 the radius R that x and y are divided by, and XDAT 3 on are
the coefficients of x, y, x², xy, y², x³, ..., as lengths.  A polynomial without a conic is held.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.prescriptions.numbers import as_number, number_in_text, scaled
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_shape import Row, ZemaxShape

_TERMS = 230
_FIRST = 3


def monomials() -> list[str]:
    """Return the names of the terms in Zemax's order: x, y, x2, xy, y2, x3, x2y, ..."""
    names: list[str] = []
    degree = 1
    while len(names) < _TERMS:
        names += [_name(degree - j, j) for j in range(degree + 1)]
        degree += 1
    return names


def _read(block: SurfaceBlock) -> Row:
    count = number_in_text(block.extra_data.get(1, "0"), f"{block.place}: XDAT 1")
    if not (0 <= count <= _TERMS and count == int(count)):
        raise InputError(f"{block.place}: XDAT 1 must be a number of terms from 0 to {_TERMS}")
    terms = {}
    for n, name in enumerate(monomials()[: int(count)], _FIRST):
        word = block.extra_data.get(n, "0")
        if number_in_text(word, f"{block.place}: XDAT {n}") or word == NAMED_ZERO:
            terms[name] = scaled(word, _unit(block, name), f"{block.place}: XDAT {n}")
    curvature, conic = block.curvature, block.number("CONI")
    if not terms:
        return {"type": "conic", **curvature_row(curvature), "conic": conic}
    if curvature:
        raise InputError(
            f"{block.place}: a conic plus a polynomial in x and y is not held (TYPE XPOLYNOM; "
            "allowed: CURV 0)"
        )
    return {"type": "xy_polynomial", **terms}


def _unit(block: SurfaceBlock, name: str) -> Fraction:
    """Return mm^(1 - degree) in the unit of a term's coefficient."""
    word = block.extra_data.get(2, "1")
    if number_in_text(word, f"{block.place}: XDAT 2") <= 0.0:
        raise InputError(f"{block.place}: XDAT 2, the radius of normalization, must be positive")
    i, j = monomial_powers(name) or (0, 0)
    return block.factor / (Fraction(word) * block.factor) ** (i + j)


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    names = monomials()
    terms = {key: value for key, value in row.items() if monomial_powers(key) is not None}
    for key in terms:
        if key not in names:
            raise InputError(
                f"{place}: a .zmx file cannot hold '{key}' (allowed: x, y to {names[-1]})"
            )
    count = max((names.index(key) + 1 for key in terms), default=0)
    lines = ['CURV 0.0 0 0 0 0 ""', f"XDAT 1 {count}", "XDAT 2 1.0"]
    for n, name in enumerate(names[:count], _FIRST):
        lines.append(f"XDAT {n} {_text(terms.get(name), place)}")
    return lines


def _text(value: object, place: str) -> str:
    """Return a number; a coefficient that is named and zero has the text of one."""
    return "0" if value is None else repr(as_number(value, place) or float(NAMED_ZERO))


def _name(i: int, j: int) -> str:
    return "".join(
        letter + (str(power) if power > 1 else "")
        for letter, power in (("x", i), ("y", j))
        if power
    )


XY_POLYNOMIAL = ZemaxShape(
    "XPOLYNOM", ("xy_polynomial",), _read, _write, extra_data=range(1, _FIRST + _TERMS)
)
