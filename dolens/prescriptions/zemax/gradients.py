"""The gradient-index media behind Zemax's surfaces GRINSUR1 to GRINSUR6, GRINSUR9, GRINSU10 and
GRINSU12.

Their surface is that of TYPE STANDARD, and PARM has the profile of the medium behind it: PARM 1 is
the largest step of a ray, which dolens chooses itself, PARM 2 the index at the vertex (its square
for GRINSUR2), and the others are coefficients, in the file's unit of length.  GRINSU10 is a series
of |y|, of which even powers are held: the others have a kink on the axis.  GRINSU12 has the order
of its polynomials in PARM 2 and the index in PARM 3; then come coefficients of x, y and z, of x²,
y² and z², and so on.  GRINSUR6 and GRINSUR9 are glasses of a file (see
`dolens.prescriptions.zemax.gradient_files`).  GRINSUR5 and GRINSUR9 add x·tan α + y·tan β to the
sag, which is held for planes.

Source: OpticStudio's help, "Gradient 1" to "Gradient 12".
"""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.optics.gradients import MOST_POWERS, Gradient
from dolens.optics.materials import Material, index_model, parse_material
from dolens.prescriptions.zemax.file import SurfaceBlock
from dolens.prescriptions.zemax.gradient_files import FILES, gradient_glass
from dolens.prescriptions.zemax.table import ZemaxShape, named

# TYPE → terms of PARM 3, PARM 4, ...
GRADIENTS: dict[str, tuple[str, ...]] = {
    "GRINSUR1": ("r2",),
    "GRINSUR2": ("r2", "r4", "r6", "r8", "r10", "r12"),
    "GRINSUR3": ("r2", "r4", "r6", "z", "z2", "z3"),
    "GRINSUR4": ("x", "x2", "y", "y2", "z", "z2"),
    "GRINSUR5": ("r2", "r4", "z", "z2", "z3", "z4"),
    "GRINSU10": ("y", "y2", "y3", "y4", "y5", "y6"),
    "GRINSU12": tuple(
        f"{axis}{power if power > 1 else ''}"
        for power in range(1, MOST_POWERS + 1)
        for axis in "xyz"
    ),
}
_SQUARED, _ORDERED = "GRINSUR2", "GRINSU12"
_KINKED = "an odd power of |y| is not held in a gradient"
# TYPE → the slots of PARM that no medium holds, and what they are about.
REFUSED = {
    "GRINSUR1": {"PARM 4": "a term in r, with a kink on the axis, is not held in a gradient"},
    "GRINSU10": dict.fromkeys(("PARM 3", "PARM 5", "PARM 7"), _KINKED),
}
# TYPE → the slots of the tangents of a tilt along x and y, which are added to the sag.
TANGENTS = {"GRINSUR5": ("PARM 9", "PARM 10"), "GRINSUR9": ("PARM 2", "PARM 3")}
# TYPE → the last slot of PARM that has a meaning.
SLOTS = {
    **{kind: 2 + len(terms) + (kind == _ORDERED) for kind, terms in GRADIENTS.items()},
    **{"GRINSUR5": 10, "GRINSUR6": 1, "GRINSUR9": 3},
}


def tilted_row(shape: ZemaxShape, block: SurfaceBlock) -> dict[str, Any]:
    """Return the row of a surface in front of a gradient: a conic, or a tilted plane.

    Raises:
        InputError: a curved surface is tilted.
    """
    slots = TANGENTS.get(block.type, ())
    tangents = {axis: block.slot(slot) for axis, slot in zip("xy", slots, strict=False)}
    if not any(tangents.values()):
        return shape.by_table(block)
    if block.number("CURV"):
        raise InputError(
            f"{block.place}: a curved surface with a tilt is not held in front of a gradient"
        )
    return {"type": "xy_polynomial", **tangents}


def gradient_medium(block: SurfaceBlock) -> str | None:
    """Return the medium behind a surface as a prescription writes it; None where it has no profile.

    Raises:
        InputError: the index is not positive, or its dispersion stands in another file.
    """
    glass = block.words("GLAS")
    if block.type in FILES:
        return _of_a_file(block, glass)
    terms = GRADIENTS.get(block.type)
    if terms is None:
        return None
    if glass:
        raise InputError(
            f"{block.place}: a gradient-index medium with a dispersion of its own is not held "
            f"(GLAS {glass[0]}, which stands in Zemax's SGRIN.DAT)"
        )
    ordered = block.type == _ORDERED
    first = f"PARM {3 if ordered else 2}"
    n = block.slot(first)
    if not n > 0.0:
        raise InputError(
            f"{block.place}: {first}, the index at the vertex, must be positive, not {n:g}"
        )
    squared = block.type == _SQUARED
    values = {
        term: block.slot(slot, -_power(term))
        for slot, term in _slots(block.type).items()
        if named(block.slots.get(slot, "0"))
    }
    order = block.slot("PARM 2") if ordered else 0.0
    beyond = [t for t, v in values.items() if v and _power(t) > order] if ordered else []
    if beyond:
        raise InputError(
            f"{block.place}: PARM 2 says that the polynomials are of order {order:g}, but there is "
            f"a coefficient of {beyond[0]}"
        )
    base = repr(math.sqrt(n) if squared else n)
    words = [f"{term}={value!r}" for term, value in values.items()]
    return " ".join([f"gradient{'_squared' * squared}", base, *words]) if words else base


def _slots(kind: str) -> dict[str, str]:
    """Return slot → term of the coefficients of a TYPE."""
    first = 4 if kind == _ORDERED else 3
    return {f"PARM {slot}": term for slot, term in enumerate(GRADIENTS[kind], first)}


def _power(term: str) -> int:
    return int(term[1:] or 1)


def gradient_lines(row: Mapping[str, Any], place: str) -> tuple[str, list[str]] | None:
    """Return the TYPE and the lines PARM of the surface in front of a gradient; None where a row of
    a prescription has none.

    Raises:
        InputError: Zemax has no such gradient, or none behind a surface of this type.
    """
    material = str(row.get("material"))
    if not material.lower().startswith("gradient"):
        return None
    medium = parse_material(material, index_model("dfc"))
    assert isinstance(medium, Gradient)  # as its first word says
    refused = f"{place}: a .zmx file cannot hold material '{material}'"
    if medium.dispersions or not isinstance(medium.base, Material) or medium.base.b:
        raise InputError(f"{refused}: the index is written for one wavelength there")
    if row.get("type", "sphere") not in _IN_FRONT or row.get("phase"):
        raise InputError(f"{refused} behind a surface that is no {', '.join(_IN_FRONT)}")
    values = dict(medium.terms)
    kinds = (kind for kind in _WRITTEN if (kind == _SQUARED) == medium.squared)
    kind = next((kind for kind in kinds if values.keys() <= {*GRADIENTS[kind]}), None)
    if kind is None:
        raise InputError(f"{refused}: no gradient of Zemax's has these terms together")
    n = medium.base.a
    numbers = {"PARM 2": repr(n * n if medium.squared else n)}
    if kind == _ORDERED:
        numbers = {"PARM 2": f"{max(map(_power, values))}", "PARM 3": repr(n)}
    numbers |= {s: repr(values[term]) for s, term in _slots(kind).items() if term in values}
    return kind, [f"{slot} {number}" for slot, number in numbers.items()]


_IN_FRONT = ("plane", "sphere", "conic")
_WRITTEN = ("GRINSUR1", "GRINSUR3", "GRINSUR4", "GRINSUR5", "GRINSUR2", "GRINSU12")


def _of_a_file(block: SurfaceBlock, glass: list[str]) -> str:
    if not glass:
        raise InputError(f"{block.place}: TYPE {block.type} needs GLAS, a gradient-index glass")
    if block.factor != 1:
        raise InputError(
            f"{block.place}: the gradient-index glass {glass[0]} is given in mm, and the file is "
            "in another unit of length"
        )
    return gradient_glass(block.type, glass[0], block.place)
