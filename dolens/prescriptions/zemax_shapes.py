"""Shapes of surfaces are read from a Zemax `.zmx` file and written to it, by a table.

`TYPE` names the shape of a surface; its numbers stand behind CURV, CONI, PARM and XDAT.  Each shape
here has a file of its own that says how a block of lines becomes a row of a prescription, and how
the row becomes lines.  What all surfaces have in common (medium, aperture, gap, remark) is read and
written for all of them in `zemax_reader` and `zemax_writer`.
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.zemax.file import SurfaceBlock
from dolens.prescriptions.zemax_biconic_toroid import BICONIC, TOROID
from dolens.prescriptions.zemax_coordinate_break import COORDINATE_BREAK
from dolens.prescriptions.zemax_diffractive import (
    BINARY_1,
    BINARY_2,
    GRATING,
    PARAXIAL,
    TOROIDAL_GRATING,
)
from dolens.prescriptions.zemax_even_asphere import EVEN_ASPHERE
from dolens.prescriptions.zemax_grid_sag import GRID_SAG
from dolens.prescriptions.zemax_irregular import IRREGULAR
from dolens.prescriptions.zemax_polynomials import (
    EXTENDED_ASPHERE,
    EXTENDED_ODD_ASPHERE,
    FORBES,
    ODD_ASPHERE,
)
from dolens.prescriptions.zemax_shape import ZemaxShape
from dolens.prescriptions.zemax_standard import JONES_MATRIX, STANDARD
from dolens.prescriptions.zemax_tilted_plane import TILTED_PLANE
from dolens.prescriptions.zemax_xy_polynomial import XY_POLYNOMIAL
from dolens.prescriptions.zemax_zernike import ZERNIKE_FRINGE, ZERNIKE_STANDARD
from dolens.prescriptions.zemax_zernike_phase import FRINGE_PHASE, STANDARD_PHASE

# One line here makes a shape known to the reader and the writer.
SHAPES: dict[str, ZemaxShape] = {
    shape.type: shape
    for shape in (
        *(STANDARD, EVEN_ASPHERE, TILTED_PLANE, XY_POLYNOMIAL, COORDINATE_BREAK),
        *(PARAXIAL, GRATING, TOROIDAL_GRATING, BINARY_1, BINARY_2),
        ODD_ASPHERE,
        EXTENDED_ASPHERE,
        EXTENDED_ODD_ASPHERE,
        BICONIC,
        TOROID,
        ZERNIKE_STANDARD,
        ZERNIKE_FRINGE,
        FRINGE_PHASE,
        STANDARD_PHASE,
        IRREGULAR,
        FORBES,
        GRID_SAG,
        JONES_MATRIX,
    )
}
# What the beginning of a TYPE means that no row holds: a file that has one is refused by this name.
_NOT_HELD = {
    "ABCD": "a surface given by its ABCD matrix",
    "BICONICZ": "a biconic surface with Zernike terms",
    "BINARY": "a diffractive phase",
    "BIRE": "a birefringent medium",
    "CADPART": "a part from a CAD program",
    "CONJUGAT": "a surface given by two conjugate points",
    "CUBICSPL": "a cubic spline",
    "CYLINDER": "a cylinder",
    "EASPHERE": "an extended asphere",
    "EGRATING": "an elliptical grating",
    "ELLIPGRA": "an elliptical grating",
    "FRESNEL": "a Fresnel surface",
    "GENFRESN": "a Fresnel surface",
    "GRADIUM": "a gradient-index medium",
    "GRID_PHA": "a phase given on a grid",
    "GRIDPHAS": "a phase given on a grid",
    "GRIDSAG": "a sag given on a grid",
    "GRINSU": "a gradient-index medium",
    "HOLOGRM": "a hologram",
    "NONSEQCO": "a non-sequential component",
    "ODDCOSIN": "an odd cosine surface",
    "PARAX_XY": "a paraxial lens of two focal lengths",
    "PERIODIC": "a periodic surface",
    "POLYNOMI": "a polynomial surface",
    "RADIALGR": "a radial grating",
    "RETRO": "a retro-reflector",
    "SLIDE": "a slide (a picture that light passes)",
    "SUPERCON": "a superconic",
    "TOROIDGR": "a toroidal grating",
    "TOROIDHO": "a toroidal hologram",
    "USERSURF": "a surface that a program of the user computes",
    "VLINGRAT": "a grating of varying line spacing",
    "ZONEPLAT": "a Fresnel zone plate",
    "ZONEPLAN": "a Fresnel zone plate",
}


def shape_of_block(block: SurfaceBlock) -> ZemaxShape:
    """Return the shape that a block's TYPE names.

    Raises:
        InputError: no row of a prescription holds it; the message says what it is, or a number of
            its list is given that the shape does not have.
    """
    kind = block.type
    shape = SHAPES.get(kind)
    if shape is None:
        names = (name for start, name in _NOT_HELD.items() if kind.startswith(start))
        what = next(names, "a kind of surface that is not known here")
        raise InputError(
            f"{block.place}: {what} is not held (TYPE {kind}; allowed: {', '.join(SHAPES)})"
        )
    for operand, given, allowed in (
        ("PARM", block.parameters, shape.parameters),
        ("XDAT", block.extra_data, shape.extra_data),
    ):
        for n, word in given.items():
            if allowed is not None and n not in allowed and float(word) != 0.0:
                raise InputError(
                    f"{block.place}: {operand} {n} is {word}, but TYPE {kind} has "
                    f"{f'{operand} {allowed[0]} to {allowed[-1]}' if allowed else 'none'}"
                )
    return shape


def shape_of_row(row: Mapping[str, Any], place: str) -> ZemaxShape:
    """Return the shape that writes a row of a prescription.

    Raises:
        InputError: a `.zmx` file cannot hold its `type`.
    """
    kind, phase = str(row.get("type", "sphere")), (row.get("phase") or {}).get("type", "")
    for shape in SHAPES.values():
        if kind in shape.kinds and shape.phase == phase:
            return shape
    if phase:
        raise InputError(
            f"{place}: a .zmx file cannot hold a phase of type '{phase}' on a surface of type "
            f"'{kind}'"
        )
    plain = (shape for shape in SHAPES.values() if not shape.phase)
    allowed = dict.fromkeys(kind for shape in plain for kind in shape.kinds)
    raise InputError(
        f"{place}: a .zmx file cannot hold type '{kind}' (allowed: {', '.join(allowed)})"
    )
