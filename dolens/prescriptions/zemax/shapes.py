"""The table of the TYPEs of a Zemax `.zmx` file, and the few that need code of their own.

A coefficient's slot and unit stand here once, for the reader and the writer.  What all surfaces
have in common (medium, aperture, gap, remark) is read and written in `reader` and `writer`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from dolens.errors import InputError
from dolens.optics.elements import TILTS as POSE_TILTS
from dolens.optics.surfaces.coordinate_break import BREAK, DECENTERS
from dolens.optics.surfaces.zernike import ZernikeFringe, ZernikeSag, ZernikeStandard
from dolens.optics.surfaces.zernike_phase import (
    ZernikeFringePhase,
    ZernikePhase,
    ZernikeStandardPhase,
)
from dolens.prescriptions.numbers import as_number, power_of
from dolens.prescriptions.other_programs import ALWAYS, Number, monomials, powers_of_r
from dolens.prescriptions.row_data import BREAK_KIND
from dolens.prescriptions.zemax.file import SurfaceBlock, grid_lines, read_grid
from dolens.prescriptions.zemax.gradients import REFUSED, SLOTS, tilted_row
from dolens.prescriptions.zemax.table import (
    CONIC,
    ORDER,
    ORDER_BUT_0,
    PLAIN,
    RADIUS,
    TWO_CURVES,
    Base,
    Row,
    ZemaxShape,
    named,
)

# Terms of a list in XDAT.
_MOST = 240
_PLAIN_KINDS = ("plane", "sphere", "conic")
_MONOMIALS = monomials(20)
_NORM_RADIUS = Number("norm_radius", 1, RADIUS, 1.0)


def _parm(*numbers: int) -> tuple[str, ...]:
    return tuple(f"PARM {n}" for n in numbers)


def _terms(keys: Iterable[str], power: int, first: int = 3) -> dict[str, Number]:
    """Return terms in XDAT, all of them in one power of the unit."""
    return {f"XDAT {n}": Number(key, power) for n, key in enumerate(keys, first)}


def _powers(step: int) -> dict[str, Number]:
    """Return terms in XDAT that are the coefficients of every power of r, or of every second."""
    slots = (f"XDAT {n}" for n in range(3, 3 + _MOST))
    return powers_of_r(slots, range(step, step * _MOST + 1, step))


# The coefficients of r² to r¹⁶.
_EVEN = powers_of_r(_parm(*range(1, 9)), range(2, 17, 2))


def _read_standard(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    """Return what the base is; the stop in one medium that is flat is an aperture."""
    flat = block.curvature == 0.0 and "CONI" not in block.lines
    if flat and block.stop and block.material == block.before:
        return {"type": "aperture"}
    return shape.by_table(block)


def _even_asphere(block: SurfaceBlock, most: int) -> Row:
    """Return the coefficients that the file lists, up to PARM `most`.

    Programs list all eight, or more, used or not: then the zeros behind the last that is used are
    left out.
    """
    given = [n for n in range(1, most + 1) if f"PARM {n}" in block.slots]
    found = {f"a{2 * n}": block.slot(f"PARM {n}", 1 - 2 * n) for n in given}
    if len(found) >= len(_EVEN):
        used = max((int(name[1:]) for name, value in found.items() if value), default=0)
        found = {name: value for name, value in found.items() if int(name[1:]) <= used}
    if found.get("a2") == 0.0 and not named(block.slots["PARM 1"]):
        del found["a2"]
    return {"type": "even_asphere", **CONIC.read(block), **found}


def _read_xy(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    """Return a polynomial without a conic, or a conic without a polynomial."""
    row = shape.by_table(block)
    if len(row) == 1:
        return {"type": "conic", **CONIC.read(block)}
    if block.curvature:
        raise InputError(
            f"{block.place}: a conic plus a polynomial in x and y is not held (TYPE XPOLYNOM; "
            "allowed: CURV 0)"
        )
    return row


def _read_break(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    if block.words("GLAS"):
        raise InputError(f"{block.place}: a coordinate break with a medium (GLAS) is not held")
    order = {"order": "tilt_first"} if block.slot("PARM 6") else {}
    return shape.by_table(block) | order


def _write_break(shape: ZemaxShape, row: Mapping[str, Any], place: str) -> list[str]:
    for name in POSE_TILTS:
        if f"{name}_radians" in row:
            raise InputError(
                f"{place}: a .zmx file cannot hold '{name}_radians': no number of degrees means "
                "this angle to the last bit; round it to '" + name + "'"
            )
    return [*shape.lines(row, place), f"PARM 6 {int(row.get('order') == 'tilt_first')}"]


def _read_biconic(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    row = shape.by_table(block)
    conic_y = row.pop("conic_y")
    return row | {"conic_y": conic_y}  # behind that along x


def _read_forbes(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    """Return Q_bfs (XDAT 1 is 0), whose departure is along the conic's normal, or Q_con (1)."""
    kind = block.slot("XDAT 1")
    if kind not in (0.0, 1.0):
        raise InputError(
            f"{block.place}: XDAT 1 must be 0 (Q_bfs) or 1 (Q_con), not {block.slots['XDAT 1']}"
        )
    return shape.by_table(block) | {"type": "q_con" if kind else "q_bfs"}


def _write_forbes(shape: ZemaxShape, row: Mapping[str, Any], place: str) -> list[str]:
    kind = str(int(row["type"] == "q_con"))
    return replace(shape, fixed={"XDAT 1": kind}).lines(row, place)


def _read_paraxial(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    row = shape.by_table(block)
    if row["focal_length"] == 0.0:
        raise InputError(f"{block.place}: PARM 1, the focal length of a PARAXIAL lens, is 0")
    if "MIRROR" in (word.upper() for word in block.words("GLAS")):
        raise InputError(f"{block.place}: a paraxial lens that reflects is not held (PARAXIAL)")
    return row


def _write_paraxial(shape: ZemaxShape, row: Mapping[str, Any], place: str) -> list[str]:
    length = row.get("focal_length")
    if length is None:
        length = 1.0 / as_number(row.get("power"), f"{place}: 'power'")
    power_of(length)
    return shape.lines({"focal_length": length}, place)


def _read_irregular(shape: ZemaxShape, block: SurfaceBlock) -> Row:
    """Return a conic with spherical aberration, astigmatism and coma as Fringe Zernike polynomials.

    PARM 5 to 7 are Zs, Za and Zc, the sags (as lengths) at the semi-diameter R that the surface
    has, so that with ρ = r/R and η = y/R it adds Zs·ρ⁴ + Za·η² + Zc·ρ²·η.  PARM 8 turns these.
    """
    spherical, astigmatism, coma = (block.slot(f"PARM {n}", 1) for n in (5, 6, 7))
    if not (spherical or astigmatism or coma):
        return _read_standard(STANDARD, block)
    if block.slot("PARM 8") and (astigmatism or coma):
        raise InputError(
            f"{block.place}: astigmatism and coma turned about the axis are not held (TYPE "
            "IRREGULA, PARM 8)"
        )
    radius = abs(block.length("DIAM"))
    if not radius:
        raise InputError(
            f"{block.place}: the semi-diameter (DIAM), where the irregularity is given, is missing"
        )
    row: Row = {"type": "zernike_fringe", **CONIC.read(block), "normalization_radius": radius}
    if spherical:
        row["a4"] = spherical / radius**4
    if astigmatism:
        # η² = (ρ² - ρ²·cos 2φ)/2, and ρ² = (Z4 + Z1)/2.
        row |= {"z1": 0.25 * astigmatism, "z4": 0.25 * astigmatism, "z5": -0.5 * astigmatism}
    if coma:
        # ρ²·η = (Z8 + 2·Z3)/3.
        row |= {"z3": 2.0 * coma / 3.0, "z8": coma / 3.0}
    return row


def _even_base(block: SurfaceBlock) -> Row:
    """Return an even asphere where a coefficient is not zero, or named."""
    if any(named(block.slots.get(slot, "0")) for slot in _EVEN):
        return _even_asphere(block, len(_EVEN))
    return PLAIN.read(block)


def _even_base_lines(row: Mapping[str, Any], place: str) -> list[str]:
    base = CONIC if row.get("type") == "even_asphere" else PLAIN
    return ZemaxShape("", base=base, numbers=_EVEN).lines(row, place)


def _zernike(zemax_type: str, shape: type[ZernikeSag]) -> ZemaxShape:
    """Return Zernike polynomials, their coefficients as lengths, on an even asphere."""
    return ZemaxShape(
        zemax_type,
        (shape.kind,),
        CONIC,
        {
            **_EVEN,
            "XDAT 2": Number("normalization_radius", 1, RADIUS),
            "PARM 9": Number("decenter_x", 1),
            "PARM 10": Number("decenter_y", 1),
        },
        _terms((f"z{n}" for n in range(1, shape.terms + 1)), 1),
        extrapolates=0,
        fixed={"PARM 0": "1"},
    )


def _zernike_phase(zemax_type: str, phase: type[ZernikePhase]) -> ZemaxShape:
    """Return a phase of Zernike polynomials, their coefficients in waves.

    `sc_zern2.zmx` of Zemax's short course has as its phase the fit (in waves) of the wavefront of
    `sc_zern1.zmx` with its second lens decentred by (-0.1, 0.2) mm.
    """
    return ZemaxShape(
        zemax_type,
        _PLAIN_KINDS,
        PLAIN,
        {"PARM 0": Number("order", 0, ORDER_BUT_0, 1.0), "XDAT 2": _NORM_RADIUS},
        _terms((f"z{n}" for n in range(1, phase.terms + 1)), 0),
        phase=phase.type,
        extrapolates=1,
        fixed={"PARM 1": "1"},
    )


def _binary(zemax_type: str, phase: str, keys: Iterable[str]) -> ZemaxShape:
    """Return a phase in radians, Σ A_i·E_i times the order, on an even asphere."""
    return ZemaxShape(
        zemax_type,
        (*_PLAIN_KINDS, "even_asphere"),
        Base(_even_base, _even_base_lines),
        {"PARM 0": Number("order", 0, ORDER, 1.0), "XDAT 2": _NORM_RADIUS},
        _terms(keys, 0),
        phase=phase,
        filled=True,
        others=tuple(_EVEN),
    )


def _grating(first: int) -> dict[str, Number]:
    """Return straight grooves parallel to x, whose number per µm stands at PARM `first`, and the
    order of diffraction behind it.
    """
    return {
        f"PARM {first}": Number("grooves", 0, ALWAYS, shift=3),
        f"PARM {first + 1}": Number("order", 0, ORDER, 1.0),
    }


STANDARD = ZemaxShape(
    "STANDARD",
    ("plane", "aperture", "sphere", "conic"),
    PLAIN,
    others=("PARM", "XDAT"),  # which an earlier TYPE left behind
    own_read=_read_standard,
)
# A polarizer or retarder: its eight numbers change the light's polarization and bend no ray.  Its
# plane is written as any other.
JONES_MATRIX = replace(
    STANDARD, type="JONESMAT", kinds=(), kind="plane", others=_parm(*range(1, 9))
)
SHAPES = {
    shape.type: shape
    for shape in (
        STANDARD,
        # Other programs write further powers in the same way; they are read, and not written.
        ZemaxShape(
            "EVENASPH",
            ("even_asphere",),
            CONIC,
            _EVEN,
            others=_parm(*range(9, 17)),
            own_read=lambda shape, block: _even_asphere(block, 16),
        ),
        # The plane z = x·tan θx + y·tan θy, written as XPOLYNOM, which can hold more of them.
        ZemaxShape(
            "TILTSURF",
            numbers={"PARM 1": Number("x", 0, ALWAYS), "PARM 2": Number("y", 0, ALWAYS)},
            kind="xy_polynomial",
        ),
        ZemaxShape(
            "XPOLYNOM",
            ("xy_polynomial",),
            Base(lambda block: {}, lambda row, place: ['CURV 0.0 0 0 0 0 ""']),
            terms={
                f"XDAT {n}": Number(key, 1 - degree)
                for n, (key, degree) in enumerate(_MONOMIALS.items(), 3)
            },
            scales=True,
            filled=True,
            fixed={"XDAT 2": "1.0"},
            own_read=_read_xy,
        ),
        # Right-handed turns in degrees: for PARM 6 = 0 the axes are decentred and then turned about
        # x, the new y and the new z; for any other PARM 6 about z, y and x first.  A break that
        # returns to an earlier surface (SCBD) has the numbers that Zemax found for it.  The sense:
        # Handbook of Optics, vol. II, ch. 18, no. 46 as a Zemax file has a mirror tilted by -3.32°
        # about x and 206.8 mm behind it an image decentred by +24.0739 mm in y; and a file that
        # returns by SCBD to axes from which it was turned by PARM 4 = -45 has Zemax's own decenter
        # and thickness, +14.64 and -35.36 mm, for the way back.
        ZemaxShape(
            "COORDBRK",
            (BREAK_KIND,),
            numbers={
                f"PARM {n}": Number(key, int(key in DECENTERS)) for n, key in enumerate(BREAK, 1)
            },
            filled=True,
            others=("PARM", "XDAT"),
            surface=False,
            own_read=_read_break,
            own_write=_write_break,
        ),
        # PARM 2, the OPD mode, says which conjugates path differences are computed from, and moves
        # no ray; another mode than 0 is listed (`passed_over`).
        ZemaxShape(
            "PARAXIAL",
            ("paraxial_lens",),
            Base(lambda block: {}, lambda row, place: ["CURV 0.0"]),
            {"PARM 1": Number("focal_length", 1, ALWAYS)},
            fixed={"PARM 2": "0"},
            own_read=_read_paraxial,
            own_write=_write_paraxial,
        ),
        ZemaxShape("DGRATING", _PLAIN_KINDS, PLAIN, _grating(1), phase="grating"),
        ZemaxShape(
            "TOROGRAT", ("toroid",), TWO_CURVES, _grating(2), phase="grating", others=("PARM 1",)
        ),
        _binary("BINARY_1", "xy", _MONOMIALS),
        _binary("BINARY_2", "radial", (f"p{2 * n}" for n in range(1, _MOST + 1))),
        ZemaxShape(
            "ODDASPHE", ("odd_asphere",), CONIC, powers_of_r(_parm(*range(1, 9)), range(1, 9))
        ),
        ZemaxShape("XASPHERE", (), CONIC, _EVEN, _powers(2), kind="even_asphere", scales=True),
        ZemaxShape("XOSPHERE", (), CONIC, _EVEN, _powers(1), kind="odd_asphere", scales=True),
        # Of biconics and toroids, CURV and CONI are those along y.
        ZemaxShape(
            "BICONICX",
            ("biconic",),
            TWO_CURVES,
            {"PARM 2": Number("conic_x", 0, ALWAYS, 0.0)},
            others=("PARM 1",),
            own_read=_read_biconic,
        ),
        ZemaxShape(
            "TOROIDAL",
            ("toroid",),
            TWO_CURVES,
            powers_of_r(_parm(*range(2, 9)), range(2, 15, 2)),
            refused={"XDAT": "Zernike polynomials on a toroid are not held"},
            others=("PARM 0", "PARM 1", "XDAT 1", "XDAT 2"),
        ),
        _zernike("SZERNSAG", ZernikeStandard),
        _zernike("FZERNSAG", ZernikeFringe),
        _zernike_phase("FZERNPHA", ZernikeFringePhase),
        _zernike_phase("SZERNPHA", ZernikeStandardPhase),
        ZemaxShape(
            "IRREGULA",
            refused=dict.fromkeys(
                _parm(1, 2, 3, 4), "a surface with its own decenter or tilt is not held"
            ),
            others=_parm(5, 6, 7, 8),
            own_read=_read_irregular,
        ),
        ZemaxShape(
            "QED_TYPE",
            ("q_con", "q_bfs"),
            CONIC,
            {"XDAT 3": Number("normalization_radius", 1, RADIUS)},
            _terms((f"q{n}" for n in range(_MOST)), 1, 4),
            count=2,
            fixed={"XDAT 1": "0"},
            own_read=_read_forbes,
            own_write=_write_forbes,
        ),
        ZemaxShape(
            "GRID_SAG",
            ("grid_sag",),
            CONIC,
            _EVEN,
            refused={
                "PARM 0": "linear interpolation of a grid is not held",
                "XDAT": "Zernike polynomials on a grid are not held",
            },
            others=("PARM 9", "PARM 10", "XDAT 1", "XDAT 2"),
            own_read=lambda shape, block: shape.by_table(block) | read_grid(block),
            own_write=lambda shape, row, place: [*shape.lines(row, place), *grid_lines(row, place)],
        ),
        JONES_MATRIX,
        *(
            replace(
                STANDARD,
                type=kind,
                kinds=(),
                kind="conic",
                others=_parm(*range(1, last + 1)),
                refused=REFUSED.get(kind, {}),
                own_read=tilted_row,
            )
            for kind, last in SLOTS.items()
        ),
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
    "GRADIUM": "a gradient-index medium of this kind",
    "GRID_PHA": "a phase given on a grid",
    "GRIDPHAS": "a phase given on a grid",
    "GRIDSAG": "a sag given on a grid",
    "GRINSU": "a gradient-index medium of this kind",
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
    shape.require_held(block)
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
