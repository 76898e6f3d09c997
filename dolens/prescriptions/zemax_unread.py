"""List the operands of a Zemax `.zmx` file that a prescription does not hold."""

from collections.abc import Callable

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.zemax import Line, decode_zemax

# Operands of the system: what they are, and which of their lines say anything.
_SYSTEM: dict[tuple[str, ...], tuple[str, Callable[[Line], bool]]] = {
    ("VDXN", "VDYN", "VCXN", "VCYN", "VANN"): (
        "vignetting factors",
        lambda line: any(number != 0.0 for number in _numbers(line)),
    ),
    ("FWGN",): ("weights of fields", lambda line: len(set(_numbers(line))) > 1),
    ("TOL",): ("tolerances", lambda line: line.arguments[:1] not in ([], ["TOFF"])),
    ("EFFL", "OPDX", "TRAC", "DMFS", "BLNK"): (
        "the merit function",
        lambda line: line.operand != "BLNK" or bool(line.text),
    ),
}
_SURFACE = {"COAT": "coatings", "SCAT": "scatter models"}


def unread_in_zemax(data: bytes) -> list[str]:
    """Return what a `.zmx` file says that is not read and bends no ray, in words.

    Args:
        data: the file's content.
    """
    found: dict[str, None] = {}
    weights: list[float] = []
    used = 0
    for at, raw in enumerate(decode_zemax(data).splitlines(), 1):
        words = raw.split()
        if not words:
            continue
        line = Line(at, words[0].upper(), words[1:], raw.strip()[len(words[0]) :].strip())
        for operands, (what, says) in _SYSTEM.items():
            if line.operand in operands and says(line):
                found[what] = None
        if line.operand in _SURFACE and line.text:
            found[_SURFACE[line.operand]] = None
        if line.operand == "FTYP" and len(line.arguments) > 3:
            used = int(_numbers(line)[3])
        if line.operand == "WAVM" and len(line.arguments) > 2:
            weights.append(_numbers(line)[2])
    if len(set(weights[: used or None])) > 1:
        found["weights of wavelengths"] = None
    return list(found)


def _numbers(line: Line) -> list[float]:
    """Return the arguments that are numbers; the others are 0."""
    numbers = []
    for word in line.arguments:
        try:
            numbers.append(number_in_text(word, line.operand))
        except InputError:
            numbers.append(0.0)
    return numbers
