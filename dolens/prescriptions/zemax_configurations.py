"""Configurations of a Zemax `.zmx` file are states of one lens: zoom, focus, temperature.

`MNUM count current` begins the list behind the surfaces, and each line of it says what one operand
is in one configuration: `THIC 5 2 12.5` is a gap of 12.5 behind surface 5 in configuration 2.  The
surfaces are written as they are in the current one, and that is the lens which is read.
"""

import math

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.zemax import Line, ZemaxFile

# Temperature and pressure, and what a file without ENVD means by them.
_AIR = {"TEMP": 20.0, "PRES": 1.0}
# Lines round what ENVD says to a dozen digits.
_SAME_AIR = 1e-6


def configuration_lines(file: ZemaxFile) -> list[Line]:
    """Return the lines behind MNUM that set something, of all configurations."""
    begin = file.system.get("MNUM")
    if not begin:
        return []
    return [line for line in file.tail if line.at > begin[-1].at and line.operand != "MOFF"]


def refuse_own_air(file: ZemaxFile, where: str) -> None:
    """Refuse media at a temperature or pressure that is not the system's.

    TEMP and PRES hold for the GLSS behind them, in the same configuration: so a lens may stand in a
    vacuum between windows.

    Raises:
        InputError: a GLSS of the current configuration stands behind another temperature or
            pressure than ENVD has.
    """
    begin, system = file.system.get("MNUM"), file.system.get("ENVD")
    if not begin:
        return
    words = [*begin[-1].arguments[1:2], "1"][0]
    current = number_in_text(words, f"{where}: line {begin[-1].at}: MNUM") or 1.0
    arguments = system[-1].arguments if system else []
    air = {
        operand: number_in_text(word, f"{where}: ENVD")
        for operand, word in zip(_AIR, arguments, strict=False)
    }
    here = air = _AIR | air
    for line in configuration_lines(file):
        place = f"{where}: line {line.at}: {line.operand}"
        if line.operand not in (*_AIR, "GLSS") or len(line.arguments) < 3:
            continue
        if number_in_text(line.arguments[1], place) != current:
            continue
        if line.operand in _AIR:
            here = {**here, line.operand: number_in_text(line.arguments[2], place)}
        elif any(not math.isclose(here[key], air[key], abs_tol=_SAME_AIR) for key in _AIR):
            raise InputError(
                f"{where}: surface {line.arguments[0]}: a medium at a temperature or pressure of "
                f"its own is not held (GLSS behind TEMP {here['TEMP']:g} and PRES "
                f"{here['PRES']:g}, line {line.at})"
            )


def other_configurations(file: ZemaxFile, where: str) -> list[str]:
    """Return a sentence about the configurations that are not read, none where there is one.

    Raises:
        InputError: MNUM has no whole number.
    """
    begin = file.system.get("MNUM")
    if not begin or not begin[-1].arguments:
        return []
    place = f"{where}: line {begin[-1].at}: MNUM"
    count, current = (number_in_text(word, place) for word in (*begin[-1].arguments, "1")[:2])
    if count != int(count) or current != int(current):
        raise InputError(f"{place} must have whole numbers, not '{begin[-1].text}'")
    if count < 2:
        return []
    values: dict[str, set[str]] = {}
    for line in configuration_lines(file):
        if len(line.arguments) > 2:
            values.setdefault(f"{line.operand} {line.arguments[0]}", set()).add(line.arguments[2])
    differ = [name for name, words in values.items() if len(words) > 1]
    if not differ:
        return []
    return [
        f"the other {int(count) - 1} of {int(count)} configurations, which set "
        f"{', '.join(differ)} (read: the current one, {int(current) or 1})"
    ]
