"""Media of a Zemax `.zmx` file may stand at a temperature and pressure of their own."""

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.zemax import ZemaxFile
from dolens.prescriptions.zemax_configurations import configuration_lines
from dolens.prescriptions.zemax_fields import last

# Temperature and pressure, and what a file without ENVD means by them.
_AIR = {"TEMP": 20.0, "PRES": 1.0}
# Lines round what ENVD says to a dozen digits.
_SAME_AIR = 1e-6


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
    air = _AIR | dict(zip(_AIR, given, strict=False))
    here = air
    for line in configuration_lines(file):
        place = f"{where}: line {line.at}: {line.operand}"
        if line.operand not in (*_AIR, "GLSS") or len(line.arguments) < 3:
            continue
        if number_in_text(line.arguments[1], place) != configuration:
            continue
        if line.operand in _AIR:
            here = {**here, line.operand: number_in_text(line.arguments[2], place)}
        elif any(abs(here[key] - air[key]) > _SAME_AIR for key in _AIR):
            return (
                f"surface {line.arguments[0]}: a medium at a temperature or pressure of its own is "
                f"not held (GLSS behind TEMP {here['TEMP']:g} and PRES {here['PRES']:g}, line "
                f"{line.at})"
            )
    return ""
