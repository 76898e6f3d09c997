"""The settings of a Zemax configuration take the place of the numbers of surfaces and system.

`THIC 5 2 12.5` sets, in configuration 2, what DISZ of surface 5 is in the file.
"""

import re

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.zemax import Line, ZemaxFile

# Operand → that of the surface whose first argument it is.
OF_SURFACES = {"THIC": "DISZ", "CRVT": "CURV", "CONN": "CONI", "SDIA": "DIAM"}
# Operand → that of the surface, and which argument it is.
OF_APERTURES = {"APMN": ("CLAP", 0), "APMX": ("CLAP", 1)}
# Operand → lists of the system, one number a field.
OF_FIELDS = {
    "XFIE": ("XFLN", "XFLD"),
    "YFIE": ("YFLN", "YFLD"),
    "FLWT": ("FWGN", "FWGT"),
    "FVDX": ("VDXN", "ZVDX"),
    "FVDY": ("VDYN", "ZVDY"),
    "FVCX": ("VCXN", "ZVCX"),
    "FVCY": ("VCYN", "ZVCY"),
    "FVAN": ("VANN", "ZVAN"),
}
# Operand → which argument of WAVM it is, and lists of older files, one number a wavelength.
OF_WAVELENGTHS: dict[str, tuple[int, tuple[str, ...]]] = {
    "WAVE": (1, ("WAVL", "WAVN")),
    "WLWT": (2, ("WWGT", "WWGN")),
}
_PUPILS = ("OBNA", "ENPD", "FNUM")
_AIR = ("TEMP", "PRES")
_PARAMETER = re.compile(r"PAR(\d)")


def apply_setting(file: ZemaxFile, line: Line) -> None:
    """Put the number of a line behind MNUM into its place among the surfaces and the system.

    Raises:
        InputError: the operand is none that is held, or its place is not there.
    """
    operand, (target, _, value) = line.operand, line.arguments[:3]
    at = int(number_in_text(target, f"line {line.at}"))
    parameter = _PARAMETER.fullmatch(operand)
    if operand in OF_SURFACES:
        _replace(_surface(file, at, line), OF_SURFACES[operand], 0, value)
    elif operand in OF_APERTURES:
        kind, place = OF_APERTURES[operand]
        _replace(_surface(file, at, line), kind, place, value)
    elif operand == "PRAM" or parameter:
        # Files of old have the parameter's number elsewhere.
        number = parameter[1] if parameter else (*line.arguments, *"00000")[4]
        lines = _surface(file, at, line).setdefault("PARM", [])
        if number == "0":
            raise InputError(f"{operand} of surface {at} does not say which parameter it is")
        lines[:] = [one for one in lines if one.arguments[:1] != [number]]
        lines.append(Line(line.at, "PARM", [number, value], f"{number} {value}"))
    elif operand in OF_FIELDS:
        lists = [name for name in OF_FIELDS[operand] if name in file.system]
        if not lists or "FEFD" in file.system:
            raise InputError(f"{operand} {at} has no place in the lists of fields")
        for name in lists:
            _replace(file.system, name, at - 1, value)
    elif operand in OF_WAVELENGTHS:
        place, older = OF_WAVELENGTHS[operand]
        lines = file.system.get("WAVM", [])
        for n, one in enumerate(lines):
            if one.arguments[:1] == [str(at)]:
                words = [*one.arguments, "1"][:3]
                lines[n] = one._replace(arguments=[*words[:place], value, *words[place + 1 :]])
        for name in older:
            if name in file.system and len(file.system[name][-1].arguments) >= at:
                _replace(file.system, name, at - 1, value)
    elif operand == "APER":
        given = [
            name
            for name in _PUPILS
            if name in file.system and number_in_text(file.system[name][-1].arguments[0], "")
        ]
        if "FLOA" in file.system or len(given) != 1:
            raise InputError("APER sets an aperture that the file does not have")
        _replace(file.system, given[0], 0, value)
    elif operand in _AIR and not _indices_follow_air(file):
        return
    else:
        raise InputError(f"{operand} {target} is not held")


def _indices_follow_air(file: ZemaxFile) -> bool:
    lines = file.system.get("ENVD")
    return lines is not None and lines[-1].arguments[2:3] == ["1"]


def _surface(file: ZemaxFile, number: int, line: Line) -> dict[str, list[Line]]:
    if not 0 <= number < len(file.surfaces):
        raise InputError(f"{line.operand} {number}: there is no such surface")
    return file.surfaces[number]


def _replace(lines: dict[str, list[Line]], operand: str, place: int, value: str) -> None:
    """Replace an argument of an operand's last line."""
    if operand not in lines or len(lines[operand][-1].arguments) <= place or place < 0:
        raise InputError(f"there is no {operand} whose number would change")
    last = lines[operand][-1]
    words = [*last.arguments[:place], value, *last.arguments[place + 1 :]]
    if operand == "DIAM":
        # A size that is set is the user's own, not the program's.
        words[1:2] = ["1"]
    lines[operand] = [*lines[operand][:-1], last._replace(arguments=words, text=" ".join(words))]
