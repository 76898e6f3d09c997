"""A prescription is written as the text of a CODE V `.seq` file."""

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.codev.glass import glass_word, private_glass
from dolens.prescriptions.codev.placement import aperture_lines, break_words
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.surface import (
    LETTERS,
    SPECIALS,
    number_lines,
    special_lines,
)
from dolens.prescriptions.codev.system import system_lines
from dolens.prescriptions.numbers import as_integer, as_number, number_text
from dolens.prescriptions.other_programs import (
    require_dfc,
    require_same,
    slot_values,
)
from dolens.prescriptions.row_data import canonical_digits

_TYPES = (
    *("plane", "aperture", "sphere", "conic", "even_asphere"),
    *(special.type for special in SPECIALS.values()),
    "coordinate_break",
)
_INFINITY = "1e13"
# CODE V cannot do without these.
_ALWAYS = ("wavelengths", "reference_wavelength", "fields", "entrance_pupil_diameter")


def codev_of(prescription: Mapping[str, Any], where: str = "lens") -> str:
    """Write a prescription as the text of a `.seq` file.

    Radii and lengths are in mm.  CODE V cannot do without an aperture, a wavelength and a field:
    where the prescription has none, EPD is that of the stop's size, the wavelength is the d line,
    and the field is the axis.  A constant index becomes a private glass, `occluder` air.

    Raises:
        InputError: one line that names the surface and key which the format cannot hold.
    """
    require_dfc(prescription, ".seq", where)
    surfaces = {str(n): row for n, row in prescription["surfaces"].items()}
    stop = str(as_integer(prescription.get("stop", 1), f"{where}: 'stop'"))
    for n, row in surfaces.items():
        if row.get("type", "sphere") not in _TYPES:
            raise InputError(
                f"{where}: surface {n}: a .seq file cannot hold type '{row.get('type')}' "
                f"(allowed: {', '.join(_TYPES)})"
            )
    remarks = [f"! {line}" for line in str(prescription.get("source") or "").splitlines()]
    lines = [
        *remarks,
        "RDM;LEN",
        *system_lines(prescription, where),
        *_private(prescription, surfaces),
    ]
    distance = prescription.get("object_distance")
    far = _INFINITY if distance is None else number_text(distance, where)
    medium = prescription.get("object_material", "air")
    lines.append(f"SO    0.0 {far} {_glass(medium, f'{where}: object')}".rstrip())
    sensor = prescription["sensor"]
    for n, row in surfaces.items():
        gap = number_text(row.get("thickness", sensor["distance"]), f"{where}: surface {n}")
        lines += _surface(row, gap, n == stop, f"{where}: surface {n}")
    lines += [*_image(sensor, where), "GO", ""]
    text = "\n".join(lines)
    found = read_codev(text, where).prescription
    require_same(prescription, found, ".seq", where, canonical_digits, _ALWAYS)
    return text


def _private(prescription: Mapping[str, Any], surfaces: Mapping[str, Any]) -> list[str]:
    """Write media of a constant index as a private catalogue."""
    media = [prescription.get("object_material", "air")]
    media += [row.get("material", "air") for row in surfaces.values()]
    glasses = dict(pair for medium in media for pair in private_glass(str(medium)).items())
    if not glasses:
        return []
    lines = [f"  '{name}' {index} {index}" for name, index in glasses.items()]
    return ["PRV", "  PWL 2000.0 300.0", *lines, "END"]


def _surface(row: Mapping[str, Any], gap: str, stop: bool, place: str) -> list[str]:
    """Write one surface; a coordinate break is a plane in one medium with its own axes.

    A plane is `0.0` and a sphere whose curvature happens to be zero says SPH.  Coefficients that
    are zero are written without a point (see `codev.surface`).
    """
    kind = str(row.get("type", "sphere"))
    if kind == "coordinate_break":
        return [f"S     0.0 {gap}", *break_words(dict(row), place)]
    glass = _glass(row.get("material"), place)
    radius, more = "0.0", []
    if row.get("curvature") is not None:
        more.append(f"  CUY {number_text(row['curvature'], place)}")
    elif kind not in ("plane", "aperture", "xy_polynomial"):
        number = as_number(row.get("radius", math.inf), f"{place}: 'radius'", finite=False)
        if number == 0.0:
            raise InputError(f"{place}: 'radius' is 0; write .inf for a plane")
        radius = repr(number) if math.isfinite(number) else "0.0"
    lines = [f"S     {radius} {gap} {glass}".rstrip()]
    lines += ["  STO"] if stop else []
    lines += [f'  SLB "{row["note"]}"'] if row.get("note") else []
    lines += more
    lines += {"sphere": ["  SPH"] if radius == "0.0" else [], "conic": ["  CON"]}.get(kind, [])
    if kind in ("conic", "even_asphere"):
        asphere = ["  ASP"] if kind == "even_asphere" else []
        lines += [*asphere, f"  K {number_text(row.get('conic', 0.0), place)}"]
        lines += number_lines(slot_values(LETTERS, row, place, ".seq"))
    lines += special_lines({**row, "type": kind}, place)
    return lines + aperture_lines(row, place)


def _image(sensor: Mapping[str, Any], where: str) -> list[str]:
    place = f"{where}: sensor"
    radius = sensor.get("radius")
    lines = [
        f"SI    {number_text(radius, place) if radius and math.isfinite(radius) else '0.0'} 0.0"
    ]
    if sensor.get("curvature") is not None:
        lines.append(f"  CUY {number_text(sensor['curvature'], place)}")
    if sensor.get("conic"):
        lines += ["  CON", f"  K {number_text(sensor['conic'], place)}"]
    if sensor.get("diameter"):
        lines.append(f"  CIR {as_number(sensor['diameter'], place) / 2.0!r}")
    return lines


def _glass(material: object, place: str) -> str:
    """Return the word of a medium, nothing for air."""
    text = str(material)
    if text.strip().lower() == "mirror":
        return "REFL"
    private = private_glass(text)
    return f"'{next(iter(private))}'" if private else glass_word(text, place)
