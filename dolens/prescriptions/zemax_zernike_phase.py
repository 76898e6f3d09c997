"""SZERNPHA and FZERNPHA of a Zemax `.zmx` file are conics with a phase of Zernike polynomials.

PARM 0 is the order of diffraction, and PARM 1 says whether the polynomials go on beyond the radius
of normalisation.  XDAT 1 is the number of terms, XDAT 2 that radius, and from XDAT 3 on come the
coefficients, in waves: `sc_zern2.zmx` of Zemax's short course has as its phase the fit (in waves)
of the wavefront of `sc_zern1.zmx` with its second lens decentred by (-0.1, 0.2) mm.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

from dolens.errors import InputError
from dolens.optics.surfaces.zernike_phase import (
    ZernikeFringePhase,
    ZernikePhase,
    ZernikeStandardPhase,
)
from dolens.prescriptions.numbers import as_integer, as_number, number_in_text
from dolens.prescriptions.zemax.file import SurfaceBlock
from dolens.prescriptions.zemax_diffractive import conic_base
from dolens.prescriptions.zemax_polynomials import named, number_of_terms, positive_extra, text
from dolens.prescriptions.zemax_shape import Row, ZemaxShape
from dolens.prescriptions.zemax_standard import STANDARD

_TERM = re.compile(r"z([1-9]\d*)")


def _reader(phase: type[ZernikePhase]) -> Callable[[SurfaceBlock], Row]:
    def read(block: SurfaceBlock) -> Row:
        order = block.parameter(0)
        if order != int(order) or not order:
            raise InputError(
                f"{block.place}: PARM 0, the order of diffraction, must be a whole number but 0, "
                f"not {order:g}"
            )
        count = number_of_terms(block, 1, phase.terms)
        radius = 1.0
        if count:
            positive_extra(block, 2, "the normalization radius")
            radius = block.extra(2, 1)
            reach = block.length("DIAM")
            if block.parameter(1) == 0.0 and reach > radius * (1.0 + 1e-9):
                raise InputError(
                    f"{block.place}: the aperture reaches {reach:g} mm from the centre of the "
                    f"Zernike phase, which ends at {radius:g} mm (XDAT 2) as PARM 1 is 0"
                )
        terms = {
            f"z{n}": number_in_text(block.extra_data[n + 2], f"{block.place}: XDAT {n + 2}")
            for n in range(1, count + 1)
            if named(block.extra_data.get(n + 2, "0"))
        }
        own = {"type": phase.type, "order": int(order), "norm_radius": radius, **terms}
        return {**conic_base(block), "phase": own}

    return read


def _write(row: Mapping[str, Any], place: str) -> list[str]:
    phase = row["phase"]
    terms = {int(m[1]): value for key, value in phase.items() if (m := _TERM.fullmatch(key))}
    order = as_integer(phase.get("order", 1), f"{place}: phase: 'order'")
    radius = as_number(phase.get("norm_radius", 1.0), f"{place}: phase: 'norm_radius'")
    lines = [*STANDARD.write(row, place), f"PARM 0 {order}", "PARM 1 1"]
    lines += [f"XDAT 1 {max(terms, default=0)}", f"XDAT 2 {radius!r}"]
    return lines + [f"XDAT {n + 2} {text(value, place)}" for n, value in sorted(terms.items())]


def _shape(zemax_type: str, phase: type[ZernikePhase]) -> ZemaxShape:
    return ZemaxShape(
        zemax_type,
        ("plane", "sphere", "conic"),
        _reader(phase),
        _write,
        parameters=(0, 1),
        extra_data=range(1, phase.terms + 3),
        phase=phase.type,
    )


FRINGE_PHASE = _shape("FZERNPHA", ZernikeFringePhase)
STANDARD_PHASE = _shape("SZERNPHA", ZernikeStandardPhase)
