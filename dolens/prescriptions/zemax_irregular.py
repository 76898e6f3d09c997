"""TYPE IRREGULA of a Zemax `.zmx` file is a conic with spherical aberration, astigmatism and coma.

PARM 5 to 7 are Zs, Za and Zc, the sags (as lengths) at the semi-diameter R that the surface has, so
that with ρ = r/R and η = y/R it adds Zs·ρ⁴ + Za·η² + Zc·ρ²·η.  Fringe Zernike polynomials and a
coefficient of r⁴ hold the same.  PARM 1 to 4 decentre and tilt the surface, and PARM 8 turns the
aberrations; these are held where they do nothing.
"""

from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.zemax.file import SurfaceBlock, curvature_row
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import STANDARD


def _read(block: SurfaceBlock) -> Row:
    if any(block.parameter(n) for n in range(1, 5)):
        raise InputError(
            f"{block.place}: a surface with its own decenter or tilt is not held (TYPE IRREGULA, "
            "PARM 1 to 4)"
        )
    spherical, astigmatism, coma = (block.parameter(n, 1) for n in (5, 6, 7))
    if not (spherical or astigmatism or coma):
        return STANDARD.read(block)
    if block.parameter(8) and (astigmatism or coma):
        raise InputError(
            f"{block.place}: astigmatism and coma turned about the axis are not held (TYPE "
            "IRREGULA, PARM 8)"
        )
    radius = abs(block.length("DIAM"))
    if not radius:
        raise InputError(
            f"{block.place}: the semi-diameter (DIAM), where the irregularity is given, is missing"
        )
    row: dict[str, Any] = {"type": "zernike_fringe", **curvature_row(block.curvature)}
    row |= {"conic": block.number("CONI"), "normalization_radius": radius}
    if spherical:
        row["a4"] = spherical / radius**4
    if astigmatism:
        # η² = (ρ² - ρ²·cos 2φ)/2, and ρ² = (Z4 + Z1)/2.
        row |= {"z1": 0.25 * astigmatism, "z4": 0.25 * astigmatism, "z5": -0.5 * astigmatism}
    if coma:
        # ρ²·η = (Z8 + 2·Z3)/3.
        row |= {"z3": 2.0 * coma / 3.0, "z8": coma / 3.0}
    return row


def _write(row: object, place: str) -> list[str]:
    raise InputError(f"{place}: an irregular surface is written as FZERNSAG")


IRREGULAR = ZemaxShape("IRREGULA", (), _read, _write, parameters=range(1, 9))
