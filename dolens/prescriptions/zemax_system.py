"""The system data of a Zemax `.zmx` file are its units, aperture, fields and wavelengths."""

from fractions import Fraction
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text, scaled
from dolens.prescriptions.zemax import Line, ZemaxFile

_UNITS = {"MM": Fraction(1), "CM": Fraction(10), "IN": Fraction(127, 5), "METER": Fraction(1000)}
_FIELD_KINDS = {0: "angles", 1: "heights"}
_OTHER_FIELDS = {2: "paraxial image heights", 3: "real image heights", 4: "theodolite angles"}
_MICROMETRE = Fraction(1000)


def factor_to_mm(file: ZemaxFile, where: str) -> Fraction:
    """Return millimetres in the file's unit of length; millimetres where it names none."""
    line = _last(file, "UNIT")
    unit = line.arguments[0].upper() if line and line.arguments else "MM"
    if unit not in _UNITS:
        raise InputError(f"{where}: UNIT {unit} is unknown (allowed: {', '.join(_UNITS)})")
    return _UNITS[unit]


def read_system(file: ZemaxFile, factor: Fraction, where: str) -> dict[str, Any]:
    """Read name, source, wavelengths, fields and pupil as a prescription writes them.

    Raises:
        InputError: the mode is not sequential, or a field or aperture is of a kind that a
            prescription does not hold.
    """
    mode = _last(file, "MODE")
    if mode and mode.arguments[:1] != ["SEQ"]:
        what = "a non-sequential system" if mode.arguments[:1] == ["NSC"] else "this mode"
        raise InputError(f"{where}: {what} is not held (MODE {mode.text}; allowed: SEQ)")
    found: dict[str, Any] = {}
    name = _last(file, "NAME")
    if name and name.text:
        found["name"] = name.text
    notes = [line.text.partition(" ")[2] for line in file.system.get("NOTE", [])]
    if any(notes):
        found["source"] = "\n".join(notes).strip()
    found["index_model"] = "dfc"
    kind = _last(file, "FTYP")
    found |= _wavelengths(file, kind, where)
    found |= _fields(file, kind, factor, where)
    return found | _pupil(file, factor, where)


def _wavelengths(file: ZemaxFile, kind: Line | None, where: str) -> dict[str, Any]:
    """Read wavelengths: WAVM gives one a line, WAVL (older) all in one, in µm; PWAV numbers the
    primary.

    Zemax pads WAVM to 24 lines; the fourth number of FTYP says how many are used.
    """
    texts: dict[int, tuple[str, int]] = {}
    for line in file.system.get("WAVM", []):
        if len(line.arguments) < 2:
            raise InputError(f"{where}: line {line.at}: WAVM needs a number and a wavelength in µm")
        texts[_count(line, 0, where)] = (line.arguments[1], line.at)
    listed = _last(file, "WAVL")
    if listed and not texts:
        texts = {i: (text, listed.at) for i, text in enumerate(listed.arguments, 1)}
    used = _count(kind, 3, where) if kind and len(kind.arguments) > 3 else 0
    numbers = [n for n in sorted(texts) if n <= (used or len(texts))]
    if not numbers:
        return {}
    values = [scaled(texts[n][0], _MICROMETRE, f"{where}: line {texts[n][1]}") for n in numbers]
    primary = _last(file, "PWAV")
    n = _count(primary, 0, where) if primary and primary.arguments else 1
    if n not in numbers:
        raise InputError(f"{where}: PWAV {n} is none of the wavelengths 1 to {len(numbers)}")
    return {"wavelengths": values, "reference_wavelength": values[numbers.index(n)]}


def _fields(file: ZemaxFile, kind: Line | None, factor: Fraction, where: str) -> dict[str, Any]:
    """Read fields: XFLN and YFLN list x and y; the third number of FTYP says how many are used."""
    number = _count(kind, 0, where) if kind and kind.arguments else 0
    if number not in _FIELD_KINDS:
        meant = _OTHER_FIELDS.get(number, "unknown")
        raise InputError(
            f"{where}: FTYP {number} ({meant}) is not held (allowed: 0, angles; 1, object heights)"
        )
    unit = factor if number == 1 else Fraction(1)
    if kind and len(kind.arguments) > 1 and _count(kind, 1, where) == 1:
        raise InputError(f"{where}: FTYP: telecentric object space is not held (allowed: 0)")
    lists = []
    for operands in (("XFLN", "XFLD"), ("YFLN", "YFLD")):
        line = next((line for o in operands if (line := _last(file, o))), None)
        words = line.arguments if line else []
        lists.append([scaled(w, unit, f"{where}: {operands[0]}") for w in words])
    x, y = lists
    used = _count(kind, 2, where) if kind and len(kind.arguments) > 2 else max(len(x), len(y))
    if not (x or y) or used < 1:
        return {}
    if used > max(len(x), len(y)):
        raise InputError(f"{where}: FTYP says {used} fields, XFLN and YFLN list fewer")
    padded = [values + [0.0] * (used - len(values)) for values in (x, y)]
    return {"fields": {_FIELD_KINDS[number]: [[padded[0][i], padded[1][i]] for i in range(used)]}}


def _pupil(file: ZemaxFile, factor: Fraction, where: str) -> dict[str, Any]:
    """Read the aperture of the system; nothing for FLOA, where the stop's semi-diameter says it."""
    if "FLOA" in file.system:
        return {}
    for operand in ("OBNA", "ENPD", "FNUM"):
        line = _last(file, operand)
        if line is None or not line.arguments:
            continue
        value = scaled(line.arguments[0], Fraction(1), f"{where}: {operand}")
        if value == 0.0:
            continue
        if operand == "OBNA":
            raise InputError(f"{where}: OBNA is not held (allowed: ENPD, FNUM, FLOA)")
        if operand == "ENPD":
            diameter = scaled(line.arguments[0], factor, f"{where}: ENPD")
            return {"entrance_pupil_diameter": diameter}
        if line.arguments[1:2] == ["1"] and _finite_object(file):
            raise InputError(
                f"{where}: FNUM as a working F-number is not held for a finite object "
                "(allowed: FNUM value 0, ENPD, FLOA)"
            )
        return {"f_number": value}
    return {}


def _finite_object(file: ZemaxFile) -> bool:
    lines = file.surfaces[0].get("DISZ", [])
    return bool(lines) and lines[-1].arguments[:1] not in (["INFINITY"], [])


def _last(file: ZemaxFile, operand: str) -> Line | None:
    return file.system[operand][-1] if operand in file.system else None


def _count(line: Line, at: int, where: str) -> int:
    place = f"{where}: line {line.at}: {line.operand}"
    value = number_in_text(line.arguments[at], place)
    if value != int(value) or value < 0:
        raise InputError(f"{place} must have whole numbers, not '{line.arguments[at]}'")
    return int(value)
