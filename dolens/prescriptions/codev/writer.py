"""A prescription is written as the text of a CODE V `.seq` file."""

import math
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.codev.glass import glass_word, private_glass
from dolens.prescriptions.codev.placement import aperture_lines, break_words
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.surface import (
    LETTERS,
    SPECIALS,
    number_lines,
    special_lines,
)
from dolens.prescriptions.numbers import as_integer, as_number, number_text
from dolens.prescriptions.other_programs import (
    require_dfc,
    require_same,
    slot_values,
    written_wavelengths,
)
from dolens.prescriptions.row_data import canonical_digits
from dolens.prescriptions.system_data import PUPIL_KEYS

_TYPES = (
    *("plane", "aperture", "sphere", "conic", "even_asphere"),
    *(special.type for special in SPECIALS.values()),
    "coordinate_break",
)
_INFINITY = "1e13"
_FIELDS = {"angles": "AN", "heights": "OB", "image_heights": "IM", "real_image_heights": "RI"}
_PUPILS = {
    "entrance_pupil_diameter": "EPD",
    "f_number": "FNO",
    "working_f_number": "FNO",
    "object_na": "NAO",
}
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
    lines = [*remarks, "RDM;LEN", *_system(prescription, where), *_private(prescription, surfaces)]
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


def _system(prescription: Mapping[str, Any], where: str) -> list[str]:
    waves, reference = written_wavelengths(prescription, where)
    weights = prescription.get("wavelength_weights")
    lines = [
        *_title(prescription),
        *_pupil(prescription, where),
        "DIM   M",
        f"WL    {_texts(waves, where)}",
        f"REF   {reference}",
        *([f"WTW   {_texts(weights, where)}"] if weights else []),
        *_fields(prescription.get("fields") or {"angles": [[0.0, 0.0]]}, where),
    ]
    if prescription.get("temperature") is not None:
        lines.append(f"TEM   {number_text(prescription['temperature'], where)}")
    if prescription.get("pressure") is not None:
        pressure = Decimal(number_text(prescription["pressure"], where)) * 760
        lines.append(f"PRE   {pressure}")
    return lines


def _title(prescription: Mapping[str, Any]) -> list[str]:
    name = str(prescription.get("name") or "")
    if not name:
        return []
    quote = '"' if "'" in name else "'"
    return [f"TITLE {quote}{name}{quote}"]


def _pupil(prescription: Mapping[str, Any], where: str) -> list[str]:
    """Write the aperture: the prescription's own, or the entrance pupil of its stop."""
    lines = ["TEL   Y"] if prescription.get("telecentric_object") else []
    for key in PUPIL_KEYS:
        if prescription.get(key) is not None and key in _PUPILS:
            return [*lines, f"{_PUPILS[key]:5} {number_text(prescription[key], where)}"]
    return [*lines, f"EPD   {_entrance_pupil(prescription, where)}"]


def _entrance_pupil(prescription: Mapping[str, Any], where: str) -> str:
    """Return the diameter of the entrance pupil, mm: the stop's own, or the next above it that has
    a short text, so that the stop's size is what clips.
    """
    lens = lens_from_prescription(prescription, where=where).requires_grad_(False)
    diameter = float(
        lens.first_order(lens.primary_wavelength, meridian="y").entrance_pupil.diameter
    )
    if not math.isfinite(diameter) or diameter <= 0.0:
        raise InputError(
            f"{where}: a .seq file needs an aperture, and the stop of this lens has no entrance "
            "pupil of finite size; give 'object_na'"
        )
    texts = (f"{diameter * (1.0 + margin):.12g}" for margin in (0.0, 1e-11, 1e-9))
    return next(text for text in texts if float(text) >= diameter)


def _fields(fields: Mapping[str, Any], where: str) -> list[str]:
    kind = next((name for name in _FIELDS if name in fields), "angles")
    points = fields[kind]
    lines = []
    for axis, letter in enumerate("XY"):
        values = [point[axis] for point in points]
        lines.append(f"{letter}{_FIELDS[kind]}   {_texts(values, where)}")
    if fields.get("weights"):
        lines.append(f"WTF   {_texts(fields['weights'], where)}")
    for letter in "XY" if fields.get("vignetting") else "":
        cut: dict[str, list[str]] = {"U": [], "L": []}
        for row in fields["vignetting"]:
            shift, part = (
                Decimal(number_text(row.get(f"{name}_{letter.lower()}", 0.0), where))
                for name in ("decenter", "compression")
            )
            cut["U"].append(str(part - shift))
            cut["L"].append(str(part + shift))
        lines += [f"V{end}{letter}   {' '.join(values)}" for end, values in cut.items()]
    return lines


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


def _texts(values: Any, where: str) -> str:
    return " ".join(number_text(value, where) for value in values)
