"""States of a lens are written as the configurations of a Zemax `.zmx` file.

Each state is written as a file of its own, and the numbers in which these files differ become the
operands behind MNUM, one configuration a state, with its name as the title (LTTL).  Where the lens
itself is none of its states, it has a configuration besides, which is the current one.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.states import merged_prescription
from dolens.prescriptions.zemax import Line, ZemaxFile, parse_zemax
from dolens.prescriptions.zemax_configurations import TITLE, own_title
from dolens.prescriptions.zemax_settings import (
    OF_APERTURES,
    OF_FIELDS,
    OF_SURFACES,
    OF_WAVELENGTHS,
)

_BY_LINE = {line: operand for operand, line in OF_SURFACES.items()}
_BY_PLACE = {place: operand for operand, place in OF_APERTURES.items()}
_BY_LIST = {names[0]: operand for operand, names in OF_FIELDS.items()}
_INFINITE = "1.0E+10"


class Setting(NamedTuple):
    """A `Setting` is what an operand of configurations sets: of a surface, field or wavelength.

    Attributes:
        operand: such as `THIC`.
        number: of the surface, field or wavelength.
        parameter: of a surface, for `PRAM`; 0 for others.
    """

    operand: str
    number: int
    parameter: int = 0


def configurations_of(
    prescription: Mapping[str, Any], write: Callable[[Mapping[str, Any]], str], where: str
) -> list[str]:
    """Return MNUM and the lines behind it, for a prescription with states.

    Args:
        prescription: with its states.
        write: returns the text of a file for a prescription without states.
        where: name in messages.

    Raises:
        InputError: a state has a temperature or pressure, or changes what no configuration can.
    """
    states = prescription["states"]
    files = {own_title(prescription): parse_zemax(write(prescription), where)}
    for name, overlay in states.items():
        place = f"{where}: state '{name}'"
        for key in ("temperature", "pressure"):
            if overlay.get(key) is not None:
                raise InputError(
                    f"{place}: a .zmx file cannot hold '{key}' of a state: the numbers of its "
                    "configurations are those at their temperature"
                )
        files[str(name)] = parse_zemax(
            write(merged_prescription(prescription, overlay, place)), place
        )
    settings: dict[Setting, None] = {}
    found = []
    base = next(iter(files.values()))
    for name, file in files.items():
        changes = _differences(base, file, f"{where}: state '{name}'")
        found.append(changes)
        settings |= dict.fromkeys(changes)
    first = _settings_of(base, settings)
    same = [n for n, changes in enumerate(found[1:], 1) if not changes]
    names, values = list(files), [first | changes for changes in found]
    if same:
        # The lens itself is one of its states.
        names, values = names[1:], values[1:]
        current = same[0]
    else:
        current = 1
    lines = [f"MNUM {len(names)} {current}"]
    for n, name in enumerate(names, 1):
        lines.append(f'{TITLE} 0 {n} "{name}" 0 0 0 1 1 0 0.0 "" 0')
    for setting in settings:
        for n, of_state in enumerate(values, 1):
            lines.append(
                f"{setting.operand} {setting.number} {n} {of_state[setting]} 0 "
                f'{setting.parameter} 0 1 1 1 0 0 "" 0'
            )
    return lines


def _differences(base: ZemaxFile, file: ZemaxFile, place: str) -> dict[Setting, str]:
    """Return the numbers in which a file differs from another."""
    found: dict[Setting, str] = {}
    for operand in base.system.keys() | file.system.keys():
        before, after = _last(base.system, operand), _last(file.system, operand)
        if operand == "WAVM":
            # As many in both, or FTYP differs.
            pairs = zip(base.system[operand], file.system.get(operand, []), strict=False)
            for one, other in pairs:
                for name, (at, _) in OF_WAVELENGTHS.items():
                    if one.arguments[at] != other.arguments[at]:
                        found[Setting(name, int(one.arguments[0]))] = other.arguments[at]
        elif before == after:
            continue
        elif operand in _BY_LIST and len(before) == len(after):
            for n, (old, new) in enumerate(zip(before, after, strict=True), 1):
                if old != new:
                    found[Setting(_BY_LIST[operand], n)] = new
        elif operand in ("ENPD", "FNUM", "OBNA") and before[1:] == after[1:]:
            found[Setting("APER", 0)] = after[0]
        elif operand == "FTYP" and before[0] != after[0]:
            raise InputError(f"{place}: a .zmx file has fields of one kind in all its states")
        elif operand == "FTYP":
            raise InputError(
                f"{place}: a .zmx file has as many fields and wavelengths in all its states"
            )
        elif operand != "NAME":
            raise InputError(f"{place}: no configuration of a .zmx file can change {operand}")
    for n, (own, others) in enumerate(zip(base.surfaces, file.surfaces, strict=True)):
        found |= _of_surface(n, own, others, place)
    return found


def _of_surface(
    n: int, before: dict[str, list[Line]], after: dict[str, list[Line]], place: str
) -> dict[Setting, str]:
    found: dict[Setting, str] = {}
    for operand in before.keys() | after.keys():
        one, other = _last(before, operand), _last(after, operand)
        if operand == "PARM":
            numbers = [
                {line.arguments[0]: line.arguments[1] for line in lines.get(operand, [])}
                for lines in (before, after)
            ]
            for key in numbers[0].keys() | numbers[1].keys():
                if numbers[0].get(key) != numbers[1].get(key):
                    found[Setting("PRAM", n, int(key))] = numbers[1].get(key, "0.0")
        elif one == other:
            continue
        elif operand in _BY_LINE and one[1:] == other[1:]:
            value = _INFINITE if other[0].upper() == "INFINITY" else other[0]
            found[Setting(_BY_LINE[operand], n)] = value
        elif len(one) == len(other) and all((operand, at) in _BY_PLACE for at in (0, 1)):
            for at, (was, is_now) in enumerate(zip(one, other, strict=True)):
                if was != is_now:
                    found[Setting(_BY_PLACE[operand, at], n)] = is_now
        else:
            raise InputError(
                f"{place}: surface {n}: no configuration of a .zmx file can change {operand}"
            )
    return found


def _settings_of(file: ZemaxFile, settings: Mapping[Setting, None]) -> dict[Setting, str]:
    """Return what a file itself says where configurations differ."""
    found = {}
    for setting in settings:
        operand, n, parameter = setting
        if operand == "PRAM":
            lines = file.surfaces[n].get("PARM", [])
            numbers = {line.arguments[0]: line.arguments[1] for line in lines}
            found[setting] = numbers.get(str(parameter), "0.0")
        elif operand in OF_SURFACES:
            word = (_last(file.surfaces[n], OF_SURFACES[operand]) or ["0.0"])[0]
            found[setting] = _INFINITE if word.upper() == "INFINITY" else word
        elif operand in OF_APERTURES:
            kind, at = OF_APERTURES[operand]
            found[setting] = _last(file.surfaces[n], kind)[at]
        elif operand in OF_FIELDS:
            found[setting] = _last(file.system, OF_FIELDS[operand][0])[n - 1]
        elif operand in OF_WAVELENGTHS:
            at, _ = OF_WAVELENGTHS[operand]
            found[setting] = file.system["WAVM"][n - 1].arguments[at]
        else:
            pupil = next(name for name in ("ENPD", "FNUM", "OBNA") if name in file.system)
            found[setting] = _last(file.system, pupil)[0]
    return found


def _last(lines: Mapping[str, list[Line]], operand: str) -> list[str]:
    return lines[operand][-1].arguments if operand in lines else []
