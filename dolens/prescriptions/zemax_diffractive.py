"""TYPEs of a Zemax `.zmx` file that deflect light otherwise than by refraction alone.

DGRATING is a plane, sphere or conic with straight grooves parallel to x: PARM 1 their number per
µm, PARM 2 the order.  TOROGRAT is a toroid with such grooves: PARM 1 its radius of rotation, PARM 2
and 3 as those.

BINARY_1 and BINARY_2 are even aspheres (PARM 1 to 8: r² to r¹⁶) with a phase in radians, PARM 0
times Σ A_i·E_i: of BINARY_2 the powers ρ², ρ⁴, ..., of BINARY_1 the monomials x, y, x², xy, y²,
....  XDAT 1 is the number of terms, XDAT 2 the radius that coordinates are divided by, and XDAT 3
on are the coefficients.

PARAXIAL is an ideal lens: PARM 1 its focal length (in air), PARM 2 its OPD mode, which moves no
ray: it says which conjugates its path differences are computed from.  Every mode is read as mode 0,
and another one listed (`zemax_passed_over`); see `dolens.optics.surfaces.ideal_lens`.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.prescriptions.numbers import as_integer, as_number, number_in_text, scaled, shifted
from dolens.prescriptions.row_data import power_of
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_biconic_toroid import TOROID
from dolens.prescriptions.zemax_even_asphere import EVEN_ASPHERE
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import STANDARD
from dolens.prescriptions.zemax_xy_polynomial import monomials

_RADIAL_TERMS = 240
_FIRST = 3
_RADIAL = re.compile(r"p([1-9]\d*)")
_ASPHERE_TERMS = range(1, 9)


def _read_grating(block: SurfaceBlock) -> Row:
    grooves = scaled(block.parameters.get(1, "0"), Fraction(1000), f"{block.place}: PARM 1")
    return {
        **conic_base(block),
        "phase": {"type": "grating", "order": _order(block, 2), "grooves": grooves},
    }


def _write_grating(row: Mapping[str, Any], place: str) -> list[str]:
    phase = row["phase"]
    grooves = as_number(phase.get("grooves"), f"{place}: phase: 'grooves'")
    order = as_integer(phase.get("order", 1), f"{place}: phase: 'order'")
    return [*STANDARD.write(row, place), f"PARM 1 {shifted(grooves, -3)}", f"PARM 2 {order}"]


def _read_toroidal_grating(block: SurfaceBlock) -> Row:
    grooves = scaled(block.parameters.get(2, "0"), Fraction(1000), f"{block.place}: PARM 2")
    own = [line for line in block.lines.get("PARM", []) if float(line.arguments[0]) == 1.0]
    toroid = replace(block, lines={**block.lines, "PARM": own})
    return {
        **TOROID.read(toroid),
        "phase": {"type": "grating", "order": _order(block, 3), "grooves": grooves},
    }


def _write_toroidal_grating(row: Mapping[str, Any], place: str) -> list[str]:
    if any(key.startswith("a") and key[1:].isdigit() for key in row):
        raise InputError(f"{place}: a .zmx file cannot hold a grating on an aspheric toroid")
    grating = _write_grating({"phase": row["phase"]}, place)[-2:]
    lines = (line.split() for line in grating)
    return [*TOROID.write(row, place), *(f"PARM {int(n) + 1} {word}" for _, n, word in lines)]


def conic_base(block: SurfaceBlock) -> Row:
    """Return a conic where CONI is given; a plane where CURV is `0`, without a decimal point."""
    if "CONI" in block.lines:
        conic = block.number("CONI")
        return {"type": "conic", **curvature_row(block.curvature), "conic": conic}
    if (block.words("CURV") or ["0"])[0] == "0":
        return {"type": "plane"}
    return {"type": "sphere", **curvature_row(block.curvature)}


def _read_radial(block: SurfaceBlock) -> Row:
    names = [f"p{2 * n}" for n in range(1, _RADIAL_TERMS + 1)]
    return {**_asphere(block), "phase": {"type": "radial", **_coefficients(block, names)}}


def _read_xy(block: SurfaceBlock) -> Row:
    return {**_asphere(block), "phase": {"type": "xy", **_coefficients(block, monomials())}}


def _asphere(block: SurfaceBlock) -> Row:
    """Return the base: an even asphere where a coefficient is not zero, or named."""
    words = [block.parameters.get(n, "0") for n in _ASPHERE_TERMS]
    if any(float(word) or word == NAMED_ZERO for word in words):
        return EVEN_ASPHERE.read(_without_order(block))
    return conic_base(block)


def _without_order(block: SurfaceBlock) -> SurfaceBlock:
    """Return the block with the PARM 1 to 8 alone."""
    kept = [
        line for line in block.lines.get("PARM", []) if float(line.arguments[0]) in _ASPHERE_TERMS
    ]
    lines = {**block.lines, "PARM": kept}
    return SurfaceBlock(lines, block.factor, block.place, block.before, block.material)


def _coefficients(block: SurfaceBlock, names: list[str]) -> Row:
    """Return order, radius of normalisation and coefficients; zeros that no one named are left
    out.
    """
    count = number_in_text(block.extra_data.get(1, "0"), f"{block.place}: XDAT 1")
    if not (0 <= count <= len(names) and count == int(count)):
        raise InputError(f"{block.place}: XDAT 1 must be a number of terms from 0 to {len(names)}")
    radius = block.extra(2, 1)
    if count and radius <= 0.0:
        raise InputError(f"{block.place}: XDAT 2, the radius of normalization, must be positive")
    terms = {}
    for n, name in enumerate(names[: int(count)], _FIRST):
        word = block.extra_data.get(n, "0")
        value = number_in_text(word, f"{block.place}: XDAT {n}")
        if value or word == NAMED_ZERO:
            terms[name] = value
    return {"order": _order(block, 0), "norm_radius": radius if count else 1.0, **terms}


def _order(block: SurfaceBlock, n: int) -> int:
    """Return the order of diffraction.

    Raises:
        InputError: PARM n does not give it, or no whole number.
    """
    if n not in block.parameters:
        raise InputError(f"{block.place}: PARM {n}, the order of diffraction, is missing")
    order = block.parameter(n)
    if order != int(order):
        raise InputError(
            f"{block.place}: PARM {n}, the order of diffraction, must be a whole number, not "
            f"{order}"
        )
    return int(order)


def _write_phase(row: Mapping[str, Any], place: str) -> list[str]:
    phase = row["phase"]
    base = EVEN_ASPHERE if row.get("type") == "even_asphere" else STANDARD
    names = (
        [f"p{2 * n}" for n in range(1, _RADIAL_TERMS + 1)]
        if phase["type"] == "radial"
        else monomials()
    )
    terms = {
        key: value
        for key, value in phase.items()
        if _RADIAL.fullmatch(key) or monomial_powers(key) is not None
    }
    for key in terms:
        if key not in names:
            raise InputError(
                f"{place}: phase: a .zmx file cannot hold '{key}' (allowed: {names[0]} to "
                f"{names[-1]})"
            )
    count = max((names.index(key) + 1 for key in terms), default=0)
    radius = as_number(phase.get("norm_radius", 1.0), f"{place}: phase: 'norm_radius'")
    order = as_integer(phase.get("order", 1), f"{place}: phase: 'order'")
    lines = [*base.write(row, place), f"PARM 0 {order}"]
    if count:
        lines += [f"XDAT 1 {count}", f"XDAT 2 {radius!r}"]
    for n, name in enumerate(names[:count], _FIRST):
        value = terms.get(name)
        text = "0" if value is None else repr(as_number(value, place) or float(NAMED_ZERO))
        lines.append(f"XDAT {n} {text}")
    return lines


def _read_paraxial(block: SurfaceBlock) -> Row:
    length = block.parameter(1, 1)
    if length == 0.0:
        raise InputError(f"{block.place}: PARM 1, the focal length of a PARAXIAL lens, is 0")
    if "MIRROR" in (word.upper() for word in block.words("GLAS")):
        raise InputError(f"{block.place}: a paraxial lens that reflects is not held (PARAXIAL)")
    return {"type": "paraxial_lens", "focal_length": length}


def _write_paraxial(row: Mapping[str, Any], place: str) -> list[str]:
    length = row.get("focal_length")
    if length is None:
        length = 1.0 / as_number(row.get("power"), f"{place}: 'power'")
    power_of(length)
    return ["CURV 0.0", f"PARM 1 {as_number(length, place)!r}", "PARM 2 0"]


_BASES = ("plane", "sphere", "conic")

GRATING = ZemaxShape(
    "DGRATING", _BASES, _read_grating, _write_grating, parameters=(1, 2), phase="grating"
)
TOROIDAL_GRATING = ZemaxShape(
    "TOROGRAT",
    ("toroid",),
    _read_toroidal_grating,
    _write_toroidal_grating,
    parameters=(1, 2, 3),
    phase="grating",
)
BINARY_1 = ZemaxShape(
    "BINARY_1",
    (*_BASES, "even_asphere"),
    _read_xy,
    _write_phase,
    parameters=range(9),
    extra_data=range(1, _FIRST + len(monomials())),
    phase="xy",
)
BINARY_2 = ZemaxShape(
    "BINARY_2",
    (*_BASES, "even_asphere"),
    _read_radial,
    _write_phase,
    parameters=range(9),
    extra_data=range(1, _FIRST + _RADIAL_TERMS),
    phase="radial",
)
PARAXIAL = ZemaxShape(
    "PARAXIAL", ("paraxial_lens",), _read_paraxial, _write_paraxial, parameters=(1, 2)
)
