"""The system data of a Zemax `.zmx` file: title, unit, aperture, air, fields and wavelengths.

`FTYP kind telecentric fields wavelengths ...` says what the coordinates of the fields are and how
many of the lists' entries are used: Zemax pads them.  `WAVM n wavelength weight` is one wavelength
in µm; older files list all of them behind WAVL or WAVN, and the weights behind WWGT or WWGN.
`XFLN` and `YFLN` (older: XFLD, YFLD) list up to twelve fields, `FWGN` (FWGT) their weights and
`VDXN` to `VANN` (ZVDX to ZVAN) the vignetting factors; further fields have a line `FEFD` each.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.fields import Vignetting
from dolens.prescriptions.numbers import number_in_text, scaled
from dolens.prescriptions.system_data import PUPIL_KEYS, unequal_weights
from dolens.prescriptions.zemax.file import Line, ZemaxFile

_ANGLES, _HEIGHTS = 0, 1
# By FTYP; angles to a finite object are those of the line to the entrance pupil.
FIELD_KINDS = {0: "angles", 1: "heights", 2: "image_heights", 3: "real_image_heights"}
PUPIL_ANGLES = "pupil_angles"
# Vignetting factors in the order of FEFD, the operand of each with its older name.
VIGNETTING_OPERANDS = (
    ("decenter_x", "VDXN", "ZVDX"),
    ("decenter_y", "VDYN", "ZVDY"),
    ("compression_x", "VCXN", "ZVCX"),
    ("compression_y", "VCYN", "ZVCY"),
    ("angle", "VANN", "ZVAN"),
)
_MICROMETRE = Fraction(1000)
_UNITS = {"MM": Fraction(1), "CM": Fraction(10), "IN": Fraction(127, 5), "METER": Fraction(1000)}
# Temperature and pressure, and what a file without ENVD means by them.
_USUAL_AIR = {"TEMP": 20.0, "PRES": 1.0}
# Lines round what ENVD says to a dozen digits.
_SAME_AIR = 1e-6


def _read_wavelengths(file: ZemaxFile, where: str) -> dict[str, Any]:
    """Read wavelengths (nm), the primary one, and weights where they differ."""
    texts: dict[int, tuple[str, str, int]] = {}
    for line in file.system.get("WAVM", []):
        if len(line.arguments) < 2:
            raise InputError(f"{where}: line {line.at}: WAVM needs a number and a wavelength in µm")
        n = _count_in_text(line.arguments[0], f"{where}: line {line.at}: WAVM")
        texts[n] = (line.arguments[1], (*line.arguments, "1", "1")[2], line.at)
    for listed, weighted in (("WAVL", "WWGT"), ("WAVN", "WWGN")):
        given = last(file, listed)
        if given and not texts:
            beside = last(file, weighted)
            shares = beside.arguments if beside else []
            texts = {
                i: (text, shares[i - 1] if i <= len(shares) else "1", given.at)
                for i, text in enumerate(given.arguments, 1)
            }
    used = _argument(file, 3, where)
    numbers = [n for n in sorted(texts) if n <= (used or len(texts))]
    if not numbers:
        return {}
    places = {n: f"{where}: line {texts[n][2]}" for n in numbers}
    values = [scaled(texts[n][0], _MICROMETRE, places[n]) for n in numbers]
    for value, n in zip(values, numbers, strict=True):
        require_wavelengths([value], places[n], "µm")
    weights = [number_in_text(texts[n][1], places[n]) for n in numbers]
    primary = last(file, "PWAV")
    n = 1
    if primary and primary.arguments:
        n = _count_in_text(primary.arguments[0], f"{where}: line {primary.at}: PWAV")
    if n not in numbers:
        raise InputError(f"{where}: PWAV {n} is none of the wavelengths 1 to {len(numbers)}")
    reference = values[numbers.index(n)]
    found: dict[str, Any] = {"wavelengths": values, "reference_wavelength": reference}
    place = f"{where}: weights of the wavelengths"
    return found | unequal_weights("wavelength_weights", weights, len(values), place)


def _read_fields(
    file: ZemaxFile, factor: Fraction, finite_object: bool, where: str
) -> dict[str, Any]:
    """Read fields, their weights where they differ, and vignetting factors where there are any.

    Args:
        file: the lines.
        factor: mm in the file's unit.
        finite_object: whether the object is at a finite distance.
        where: name in messages.

    Raises:
        InputError: theodolite angles, or an unknown kind of field.
    """
    number = _argument(file, 0, where)
    if number not in FIELD_KINDS:
        what = "theodolite angles are not held" if number == 4 else "is an unknown kind of field"
        raise InputError(f"{where}: FTYP {number}: {what} (allowed: 0, 1, 2, 3)")
    unit = Fraction(1) if number == _ANGLES else factor
    x = _listed(file, ("XFLN", "XFLD"), unit, where)
    y = _listed(file, ("YFLN", "YFLD"), unit, where)
    weights = _listed(file, ("FWGN", "FWGT"), Fraction(1), where)
    factors = [_listed(file, operands, Fraction(1), where) for _, *operands in VIGNETTING_OPERANDS]
    # Beyond the twelfth, a line each: x, y, weight, and the five factors.
    more = [_numbers(line, unit, where) for line in file.system.get("FEFD", [])]
    if more:
        begin = max(len(x), len(y))
        for at, values in enumerate((x, y, weights, *factors)):
            values += [1.0 if at == 2 else 0.0] * (begin - len(values))
            values += [row[at] for row in more]
    used = _argument(file, 2, where) or max(len(x), len(y))
    if not (x or y) or used < 1:
        return {}
    # What is not listed is zero, and so a field on the axis once more.
    used = min(used, max(len(x), len(y)))
    x, y = ((values + [0.0] * used)[:used] for values in (x, y))
    kind = FIELD_KINDS[number]
    if number == _ANGLES and finite_object and any((*x, *y)):
        kind = PUPIL_ANGLES
    elif number == _ANGLES and finite_object:
        kind = FIELD_KINDS[_HEIGHTS]
    fields: dict[str, Any] = {kind: [list(point) for point in zip(x, y, strict=True)]}
    place = f"{where}: weights of the fields"
    fields |= unequal_weights("weights", weights + [1.0] * used, used, place)
    rows = [
        {
            name: values[n]
            for (name, *_), values in zip(VIGNETTING_OPERANDS, factors, strict=True)
            if n < len(values) and values[n]
        }
        for n in range(used)
    ]
    if any(Vignetting(**row) != Vignetting(angle=row.get("angle", 0.0)) for row in rows):
        fields["vignetting"] = rows
    return {"fields": fields}


def _is_axial(file: ZemaxFile, where: str) -> bool:
    """Return whether all fields are on the axis."""
    fields = _read_fields(file, Fraction(1), True, where).get("fields", {})
    points: Any = next(
        (fields[kind] for kind in (*FIELD_KINDS.values(), PUPIL_ANGLES) if kind in fields), []
    )
    return not any(value for point in points for value in point)


def _is_telecentric(file: ZemaxFile, where: str) -> bool:
    """Return whether the second number of FTYP asks for parallel chief rays in object space."""
    return _argument(file, 1, where) == 1


def last(file: ZemaxFile, operand: str) -> Line | None:
    """Return the last line of an operand of the system, if there is one."""
    return file.system[operand][-1] if operand in file.system else None


def _count_in_text(text: str, place: str) -> int:
    """Read a whole number that is not negative; `InputError` names the place."""
    value = number_in_text(text, place)
    if value != int(value) or value < 0:
        raise InputError(f"{place} must have whole numbers, not '{text}'")
    return int(value)


def _argument(file: ZemaxFile, at: int, where: str) -> int:
    """Return a number of FTYP, 0 where it is not given."""
    line = last(file, "FTYP")
    if line is None or len(line.arguments) <= at:
        return 0
    return _count_in_text(line.arguments[at], f"{where}: line {line.at}: FTYP")


def _listed(file: ZemaxFile, operands: Sequence[str], unit: Fraction, where: str) -> list[float]:
    line = next((found for operand in operands if (found := last(file, operand))), None)
    return [scaled(w, unit, f"{where}: {line.operand}") for w in line.arguments] if line else []


def _numbers(line: Line, unit: Fraction, where: str) -> list[float]:
    """Return the eight numbers of FEFD; the first two have the unit of the fields."""
    words = (*line.arguments, *("0", "0", "1", *("0",) * 5)[len(line.arguments) :])
    place = f"{where}: line {line.at}: FEFD"
    return [scaled(w, unit if at < 2 else Fraction(1), place) for at, w in enumerate(words[:8])]


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
    found |= _read_wavelengths(file, where)
    found |= _read_fields(file, factor, finite_object, where)
    found |= _pupil(file, factor, finite_object, where)
    if _is_telecentric(file, where):
        if not finite_object:
            raise InputError(f"{where}: FTYP: a telecentric object space needs a finite object")
        # On the axis the chief ray is the axis, wherever the stop is.
        if not _is_axial(file, where):
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


def refuse_own_air(file: ZemaxFile, where: str) -> None:
    """Refuse media at a temperature or pressure that is not the system's.

    TEMP and PRES hold for the GLSS behind them, in the same configuration: so a lens may stand in a
    vacuum between windows.  Where MNUM does not say which configuration is the current one, one
    must be as the system is.

    Raises:
        InputError: a GLSS of the current configuration stands behind another temperature or
            pressure than ENVD has.
    """
    begin = file.system.get("MNUM")
    if not begin or not begin[-1].arguments:
        return
    place = f"{where}: line {begin[-1].at}: MNUM"
    count, *current = (number_in_text(word, place) for word in begin[-1].arguments[:2])
    # Older files give no current one.
    candidates = [current[0] or 1.0] if current else range(1, int(count) + 1)
    found = [_own_air(file, where, number) for number in candidates]
    if found and all(found):
        raise InputError(f"{where}: {found[0]}")


def _own_air(file: ZemaxFile, where: str, configuration: float) -> str:
    """Return which medium has a temperature or pressure of its own, nothing where none has."""
    line = last(file, "ENVD")
    given = [number_in_text(word, f"{where}: ENVD") for word in line.arguments[:2]] if line else []
    air = _USUAL_AIR | dict(zip(_USUAL_AIR, given, strict=False))
    here = air
    for line in file.configuration_lines():
        place = f"{where}: line {line.at}: {line.operand}"
        if line.operand not in (*_USUAL_AIR, "GLSS") or len(line.arguments) < 3:
            continue
        if number_in_text(line.arguments[1], place) != configuration:
            continue
        if line.operand in _USUAL_AIR:
            here = {**here, line.operand: number_in_text(line.arguments[2], place)}
        elif any(abs(here[key] - air[key]) > _SAME_AIR for key in _USUAL_AIR):
            return (
                f"surface {line.arguments[0]}: a medium at a temperature or pressure of its own is "
                f"not held (GLSS behind TEMP {here['TEMP']:g} and PRES {here['PRES']:g}, line "
                f"{line.at})"
            )
    return ""
