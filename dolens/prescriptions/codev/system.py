"""The system data of a CODE V `.seq` file are read and written: units, aperture, fields,
wavelengths, zoom positions.

What bends no ray is passed over, and listed.
"""

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.codev.file import CodeVFile, Command, unquoted
from dolens.prescriptions.numbers import exact, nearest, number_in_text, number_text, scaled
from dolens.prescriptions.other_programs import written_wavelengths
from dolens.prescriptions.system_data import PUPIL_KEYS, unequal_weights

_UNITS = {"M": Fraction(1), "C": Fraction(10), "I": Fraction(127, 5)}
_FIELDS = {
    "AN": "angles",
    "OB": "heights",
    "IM": "image_heights",
    "RI": "real_image_heights",
}
_PUPILS = ("EPD", "FNO", "NA", "NAO")
_WORDS = {
    "entrance_pupil_diameter": "EPD",
    "f_number": "FNO",
    "working_f_number": "FNO",
    "object_na": "NAO",
}
# Degrees Celsius and millimetres of mercury that CODE V's glass data are for.
_USUAL_TEMPERATURES = (20.0, 22.0)
_ATMOSPHERE = Fraction(760)
# Lists of wavelengths and fields, one number each; `ZOO WTW W2 1 0` is about the second.
_LISTS = (
    "WL",
    "WTW",
    "WTF",
    *(f"{axis}{kind}" for axis in "XY" for kind in _FIELDS),
)
_LISTED = re.compile(r"[WF]([1-9]\d{0,2})")


def factor_to_mm(file: CodeVFile, where: str) -> Fraction:
    """Return millimetres in the file's unit of length; millimetres where it names none."""
    command = _last(file, "DIM")
    unit = command.words[0].upper() if command and command.words else "M"
    if unit not in ("M", "MM", "C", "CM", "I", "IN"):
        raise InputError(f"{where}: DIM {unit} is unknown (allowed: M, C, I)")
    return _UNITS[unit[0]]


def read_system(
    file: CodeVFile, factor: Fraction, finite_object: bool, where: str
) -> dict[str, Any]:
    """Read name, wavelengths, fields and pupil as a prescription writes them.

    Args:
        file: the sorted commands.
        factor: mm in a unit of the file.
        finite_object: whether the object is at a finite distance; FNO then is a working F-number.
        where: name in messages.

    Raises:
        InputError: two kinds of pupils or fields, or values that do not fit together.
    """
    found: dict[str, Any] = {}
    title = _last(file, "TIT")
    name = " ".join(map(unquoted, title.words)).strip() if title else ""
    if name:
        found["name"] = name
    found["index_model"] = "dfc"
    found |= _wavelengths(file, where)
    found |= _fields(file, factor, where)
    found |= _pupil(file, factor, finite_object, where)
    return found | _surroundings(file, where)


def _wavelengths(file: CodeVFile, where: str) -> dict[str, Any]:
    """Read WL in nm, their weights, and REF, the number of the reference; else the middle one."""
    values = _numbers(file, "WL", Fraction(1), where)
    if not values:
        return {}
    reference = _last(file, "REF")
    number = (len(values) + 1) // 2
    if reference is not None and reference.words:
        number = int(number_in_text(reference.words[0], f"{where}: line {reference.at}: REF"))
    if not 1 <= number <= len(values):
        raise InputError(f"{where}: REF {number} is none of the wavelengths 1 to {len(values)}")
    found: dict[str, Any] = {"wavelengths": values, "reference_wavelength": values[number - 1]}
    weights = _numbers(file, "WTW", Fraction(1), where)
    return found | unequal_weights("wavelength_weights", weights, len(values), f"{where}: WTW")


def _fields(file: CodeVFile, factor: Fraction, where: str) -> dict[str, Any]:
    """Read fields of one kind, their weights and vignetting."""
    kinds = [kind for kind in _FIELDS if _last(file, f"X{kind}") or _last(file, f"Y{kind}")]
    if not kinds:
        return {}
    if len(kinds) > 1:
        names = " and ".join(f"Y{kind}" for kind in kinds)
        raise InputError(f"{where}: {names} are two kinds of fields; a file may give one")
    kind = kinds[0]
    unit = Fraction(1) if kind == "AN" else factor
    x, y = (_numbers(file, f"{axis}{kind}", unit, where) for axis in "XY")
    count = max(len(x), len(y))
    x, y = (values + [0.0] * (count - len(values)) for values in (x, y))
    fields: dict[str, Any] = {_FIELDS[kind]: [[x[i], y[i]] for i in range(count)]}
    weights = _numbers(file, "WTF", Fraction(1), where)
    fields |= unequal_weights("weights", weights, count, f"{where}: WTF")
    vignetting = _vignetting(file, count, where)
    if vignetting:
        fields["vignetting"] = vignetting
    return {"fields": fields}


def _vignetting(file: CodeVFile, count: int, where: str) -> list[dict[str, float]]:
    """Convert VUX, VLX, VUY and VLY: the parts of the pupil's radius that are cut at its edges.

    A pupil coordinate p from -1 to 1 becomes (VL - VU)/2 + p·(1 - (VU + VL)/2).
    """
    cut = {}
    for key in ("VUX", "VLX", "VUY", "VLY"):
        command = _last(file, key)
        words = command.words if command else []
        place = f"{where}: {key}"
        cut[key] = [exact(word, place) for word in words[:count]]
        cut[key] += [Fraction(0)] * (count - len(cut[key]))
    if not any(any(values) for values in cut.values()):
        return []
    rows = []
    for i in range(count):
        row = {}
        for axis in "XY":
            upper, lower = cut[f"VU{axis}"][i], cut[f"VL{axis}"][i]
            row[f"decenter_{axis.lower()}"] = nearest((lower - upper) / 2, where)
            row[f"compression_{axis.lower()}"] = nearest((lower + upper) / 2, where)
        rows.append(row)
    return rows


def _pupil(file: CodeVFile, factor: Fraction, finite_object: bool, where: str) -> dict[str, Any]:
    """Read the aperture of the system."""
    given = [key for key in _PUPILS if _last(file, key)]
    if len(given) > 1:
        raise InputError(f"{where}: {' and '.join(given)} both give the aperture; write one")
    found: dict[str, Any] = {}
    telecentric = _last(file, "TEL")
    if telecentric and not (telecentric.words and telecentric.words[0].upper().startswith("N")):
        found["telecentric_object"] = True
    apodized = _last(file, "PUI")
    if apodized and _number(apodized, where) != 1.0:
        raise InputError(f"{where}: PUI: apodization of the pupil is not held")
    if not given:
        return found
    command = _last(file, given[0])
    if given[0] == "EPD":
        return found | {"entrance_pupil_diameter": _number(command, where, factor)}
    value = _number(command, where)
    if given[0] == "NAO":
        return found | {"object_na": value}
    if given[0] == "NA":
        if not 0.0 < value < 1.0:
            raise InputError(f"{where}: NA must be from 0 to 1, not {value!r}")
        # The F-number is that of the paraxial cone, 1/(2·tan u) with sin u = NA.
        value = 1.0 / (2.0 * math.tan(math.asin(value)))
    return found | {"working_f_number" if finite_object else "f_number": value}


def _surroundings(file: CodeVFile, where: str) -> dict[str, Any]:
    """Read temperature (°C) and pressure (mm of mercury) where they are not the usual ones."""
    found: dict[str, Any] = {}
    temperature, pressure = _last(file, "TEM"), _last(file, "PRE")
    if temperature and _number(temperature, where) not in _USUAL_TEMPERATURES:
        found["temperature"] = _number(temperature, where)
    if pressure and _number(pressure, where, 1 / _ATMOSPHERE) != 1.0:
        found["pressure"] = _number(pressure, where, 1 / _ATMOSPHERE)
    return found


def _numbers(file: CodeVFile, key: str, factor: Fraction, where: str) -> list[float]:
    command = _last(file, key)
    place = f"{where}: line {command.at}: {key}" if command else where
    return [scaled(word, factor, place) for word in (command.words if command else [])]


def _number(command: Command | None, where: str, factor: Fraction = Fraction(1)) -> float:
    assert command is not None
    place = f"{where}: line {command.at}: {command.key}"
    if not command.words:
        raise InputError(f"{place} needs a number")
    return scaled(command.words[0], factor, place)


def _last(file: CodeVFile, key: str) -> Command | None:
    return file.system[key][-1] if key in file.system else None


def system_lines(prescription: Mapping[str, Any], where: str) -> list[str]:
    """Return the lines of a file that `read_system` and `factor_to_mm` read back.

    Raises:
        InputError: a lens without an aperture, whose stop has no entrance pupil of finite size.
    """
    waves, reference = written_wavelengths(prescription, where)
    weights = prescription.get("wavelength_weights")
    lines = [
        *_title_line(prescription),
        *_pupil_lines(prescription, where),
        "DIM   M",
        f"WL    {_texts(waves, where)}",
        f"REF   {reference}",
        *([f"WTW   {_texts(weights, where)}"] if weights else []),
        *_field_lines(prescription.get("fields") or {"angles": [[0.0, 0.0]]}, where),
    ]
    if prescription.get("temperature") is not None:
        lines.append(f"TEM   {number_text(prescription['temperature'], where)}")
    if prescription.get("pressure") is not None:
        pressure = Decimal(number_text(prescription["pressure"], where)) * 760
        lines.append(f"PRE   {pressure}")
    return lines


def _title_line(prescription: Mapping[str, Any]) -> list[str]:
    name = str(prescription.get("name") or "")
    if not name:
        return []
    quote = '"' if "'" in name else "'"
    return [f"TITLE {quote}{name}{quote}"]


def _pupil_lines(prescription: Mapping[str, Any], where: str) -> list[str]:
    """Write the aperture: the prescription's own, or the entrance pupil of its stop."""
    lines = ["TEL   Y"] if prescription.get("telecentric_object") else []
    for key in PUPIL_KEYS:
        if prescription.get(key) is not None and key in _WORDS:
            return [*lines, f"{_WORDS[key]:5} {number_text(prescription[key], where)}"]
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


def _field_lines(fields: Mapping[str, Any], where: str) -> list[str]:
    kind, name = next((pair for pair in _FIELDS.items() if pair[1] in fields), ("AN", "angles"))
    points = fields[name]
    lines = []
    for axis, letter in enumerate("XY"):
        values = [point[axis] for point in points]
        lines.append(f"{letter}{kind}   {_texts(values, where)}")
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


def _texts(values: Any, where: str) -> str:
    return " ".join(number_text(value, where) for value in values)


def passed_over(file: CodeVFile) -> list[str]:
    """Return what a file says besides its lens, in words."""
    found = []
    positions = _positions(file)
    if positions > 1:
        rest = "position 2" if positions == 2 else f"positions 2 to {positions}"
        found.append(f"{rest} of {positions} (ZOO); position 1 is read")
    blocks = file.surfaces
    if any(_has_use(block.commands, ("EDG", "HOL")) for block in blocks):
        found.append("edges and holes, which CODE V draws (EDG, HOL)")
    if any(_is_solve(block.commands) for block in blocks):
        found.append("solves, whose values are written (THI, CUY)")
    groups = {group: ", ".join(keys) for group, keys in file.passed_over.items() if group}
    return [*found, *(f"{group} ({keys})" for group, keys in groups.items())]


def require_first_position(file: CodeVFile, where: str) -> None:
    """Check that a file's lens is that of its first zoom position.

    Raises:
        InputError: the first value of ZOO is not the one that the lens has.
    """
    for command in file.zoom:
        words = command.words
        if len(words) < 3 or words[0].upper() not in (*_PUPILS, *_LISTS, "THI"):
            continue
        key, label = words[0].upper(), words[1].upper()
        place = f"{where}: line {command.at}: ZOO {key}"
        if key in _PUPILS:
            own, first = file.system.get(key), words[1]
            value = own[-1].words[0] if own and own[-1].words else None
        elif key in _LISTS:
            listed = _LISTED.fullmatch(label)
            if listed is None:
                continue
            numbers, at, first = file.system.get(key), int(listed[1]) - 1, words[2]
            # Weights that are not written are 1, and coordinates 0.
            value = "1" if key.startswith("WT") else None if key == "WL" else "0"
            if numbers and at < len(numbers[-1].words):
                value = numbers[-1].words[at]
        else:
            block = next((b for b in file.surfaces if b.label == label), None)
            given = block.words[1:2] if block else []
            for thickness in block.commands.get("THI", []) if block else []:
                given = thickness.words[:1] or given
            value, first = (given[0] if given else None), words[2]
        if value is None or number_in_text(value, place) != number_in_text(first, place):
            raise InputError(f"{place}: position 1 has {first}, and the lens {value or 'none'}")


def _positions(file: CodeVFile) -> int:
    counts = [command.words[0] for command in file.zoom if len(command.words) == 1]
    return int(counts[-1]) if counts and counts[-1].isdecimal() and len(counts[-1]) < 5 else 1


def _has_use(commands: dict, uses: tuple[str, ...]) -> bool:
    return any(
        word.upper() in uses
        for key in ("CIR", "REX", "REY")
        for command in commands.get(key, [])
        for word in command.words
    )


def _is_solve(commands: dict) -> bool:
    return any(
        command.words and command.words[0].isalpha()
        for key in ("THI", "CUY", "RDY")
        for command in commands.get(key, [])
    )
