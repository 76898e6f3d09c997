"""The system data of a Zemax `.zmx` file: title, units, aperture, air; fields and wavelengths."""

import math
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.system_data import PUPIL_KEYS
from dolens.prescriptions.zemax import ZemaxFile
from dolens.prescriptions.zemax_fields import (
    is_axial,
    is_telecentric,
    last,
    read_fields,
    read_wavelengths,
)

_UNITS = {"MM": Fraction(1), "CM": Fraction(10), "IN": Fraction(127, 5), "METER": Fraction(1000)}


def factor_to_mm(file: ZemaxFile, where: str) -> Fraction:
    """Return millimetres in the file's unit of length; millimetres where it names none."""
    line = last(file, "UNIT")
    unit = line.arguments[0].upper() if line and line.arguments else "MM"
    if unit not in _UNITS:
        raise InputError(f"{where}: UNIT {unit} is unknown (allowed: {', '.join(_UNITS)})")
    return _UNITS[unit]


def read_system(
    file: ZemaxFile, factor: Fraction, finite_object: bool, where: str
) -> dict[str, Any]:
    """Read title, source, wavelengths, fields, pupil and air as a prescription writes them.

    Raises:
        InputError: the mode is not sequential, or a field or aperture is of a kind that a
            prescription does not hold.
    """
    mode = last(file, "MODE")
    if mode and mode.arguments[:1] != ["SEQ"]:
        what = "a non-sequential system" if mode.arguments[:1] == ["NSC"] else "this mode"
        raise InputError(f"{where}: {what} is not held (MODE {mode.text}; allowed: SEQ)")
    found: dict[str, Any] = {}
    name = last(file, "NAME")
    if name and name.text:
        found["name"] = name.text
    notes = [line.text.partition(" ")[2] for line in file.system.get("NOTE", [])]
    if any(notes):
        found["source"] = "\n".join(notes).strip()
    found["index_model"] = "dfc"
    found |= read_wavelengths(file, where)
    found |= read_fields(file, factor, finite_object, where)
    found |= _pupil(file, factor, finite_object, where)
    if is_telecentric(file, where):
        if not finite_object:
            raise InputError(f"{where}: FTYP: a telecentric object space needs a finite object")
        # On the axis the chief ray is the axis, wherever the stop is.
        if not is_axial(file, where):
            found["telecentric_object"] = True
    elif _aims_real_rays(file) and not found.keys().isdisjoint(PUPIL_KEYS):
        found["real_pupil"] = True
    return found | _air(file, where)


def _aims_real_rays(file: ZemaxFile) -> bool:
    """Return whether rays are aimed at the stop that the real marginal ray fills: RAIM x 2.

    With RAIM x 0 and 1 the paraxial marginal ray fills it.
    """
    line = last(file, "RAIM")
    return line is not None and line.arguments[1:2] == ["2"]


def _pupil(file: ZemaxFile, factor: Fraction, finite_object: bool, where: str) -> dict[str, Any]:
    """Read the aperture of the system; nothing for FLOA, where the stop's semi-diameter says it."""
    if "FLOA" in file.system:
        return {}
    for operand in ("OBNA", "ENPD", "FNUM"):
        line = last(file, operand)
        if line is None or not line.arguments:
            continue
        place = f"{where}: line {line.at}: {operand}"
        value = number_in_text(line.arguments[0], place)
        if value == 0.0:
            continue
        if value < 0.0:
            raise InputError(f"{place} must be positive, not {line.arguments[0]}")
        kind = line.arguments[1:2]
        if operand == "ENPD":
            return {"entrance_pupil_diameter": scaled(line.arguments[0], factor, place)}
        if operand == "FNUM":
            return {"working_f_number" if kind == ["1"] and finite_object else "f_number": value}
        if not finite_object:
            raise InputError(f"{place}: a numerical aperture in object space needs a finite object")
        if kind == ["1"]:
            value = _sine(value, place)
        return {"object_na": value}
    return {}


def _sine(degrees: float, place: str) -> float:
    """Return the numerical aperture, in air, of the object's cone angle."""
    if degrees >= 90.0:
        raise InputError(f"{place}: light at 90 degrees to the axis and more is not held")
    return math.sin(math.radians(degrees))


def _air(file: ZemaxFile, where: str) -> dict[str, float]:
    """Read temperature (°C) and pressure (atm).

    The third number of ENVD is 1 where indices are those at this temperature and pressure; else
    they are the catalogues' own, and nothing is said here.
    """
    line = last(file, "ENVD")
    if line is None or line.arguments[2:3] != ["1"]:
        return {}
    place = f"{where}: line {line.at}: ENVD"
    temperature, pressure = (number_in_text(word, place) for word in line.arguments[:2])
    return {"temperature": temperature, "pressure": pressure}
