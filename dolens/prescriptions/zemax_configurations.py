"""Configurations of a Zemax `.zmx` file are states of one lens: zoom, focus, temperature.

`MNUM count current` begins the list behind the surfaces, and each line of it says what one operand
is in one configuration: `THIC 5 2 12.5` is a gap of 12.5 behind surface 5 in configuration 2.  The
surfaces are written as they are in the current one, and that is the lens which is read.
"""

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.zemax import Line, ZemaxFile


def configuration_lines(file: ZemaxFile) -> list[Line]:
    """Return the lines behind MNUM that set something, of all configurations."""
    begin = file.system.get("MNUM")
    if not begin:
        return []
    return [line for line in file.tail if line.at > begin[-1].at and line.operand != "MOFF"]


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
