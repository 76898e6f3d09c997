"""Numbers of a Zemax `.zmx` file's lines that stand behind those which are read.

`CURV 0.02 1 0 0 0 ""` is a curvature, and that an optimizer may change it.  What follows a number
is mostly as programs write it in every file; where it is not, it says something that is not read.
"""

from collections.abc import Iterator

from dolens.prescriptions.zemax import Line, ZemaxFile
from dolens.prescriptions.zemax_configurations import configuration_lines

_SOLVES = "variables and solves, whose results are written"
_DRAWING = "drawing and colours"
_APERTURES = "further numbers of apertures"
_FIELDS = "settings of fields"
_AIR = "temperature and pressure, which the indices do not follow"
_SYSTEM = "further numbers of the system"
_NOTHING = (0.0, '""')

# Operand of a surface → what its further words are about, how many words are read, and what
# programs always write behind them; after that, zeros and empty texts.
_OF_SURFACES: dict[str, tuple[str, int, tuple[str, ...]]] = {
    **{key: (_SOLVES, 1, ()) for key in ("CURV", "CONI", "DISZ")},
    "PARM": (_SOLVES, 2, ()),
    "XDAT": (_SOLVES, 2, ("0", "0", "1")),
    **{key: (_APERTURES, 2, ()) for key in ("CLAP", "FLAP", "SQAP", "ELAP", "OBSC", "SQOB")},
    **{key: (_APERTURES, 2, ()) for key in ("ELOB", "SPID", "OBDC")},
    **{key: (_APERTURES, 0, ()) for key in ("USAP", "USOB")},
    "DIAM": (_APERTURES, 2, ("0", "0", "1")),
    "GLAS": (_SOLVES, 6, ()),
}
_OF_THE_SYSTEM: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "ENPD": (_SYSTEM, 1, ()),
    "FNUM": (_SYSTEM, 2, ()),
    "OBNA": (_SYSTEM, 2, ()),
    "PWAV": (_SYSTEM, 1, ()),
    "WAVM": (_SYSTEM, 3, ()),
    "FTYP": (_FIELDS, 4, ()),
    "RAIM": ("ray aiming, which is always on here", 2, ("1", "1", "0", "0", "0", "0", "0", "1")),
    "ENVD": (_AIR, 3, ()),
}
# Behind the value of a configuration, by newer and by older programs.
_OF_CONFIGURATIONS = (("0", "0", "0", "1", "1"), ("0", "0", "0", "1", "1", "1"))
# TYPE → the numbers of PARM that it has, whatever an earlier TYPE left behind.
_PARAMETERS = {"STANDARD": range(0), "COORDBRK": range(1, 7)}
# The switch of HIDE that leaves a surface out.
_LEAVES_OUT = 5
# Temperature (°C) and pressure (atm) that say nothing.
_USUAL_AIR = (20.0, 1.0)


def further_numbers(file: ZemaxFile) -> Iterator[tuple[str, str]]:
    """Yield what such numbers are about, and their operand, of all that say something."""
    for operand, (group, read, usual) in _OF_THE_SYSTEM.items():
        for line in file.system.get(operand, []):
            words = line.arguments[read:]
            if operand == "FTYP" and words[3:4] == line.arguments[2:3]:
                words = [*words[:3], *words[4:]]  # the count of fields once more
            if _says(words, usual):
                yield group, operand
    for line in file.system.get("ENVD", []):
        words = line.arguments
        if words[2:3] != ["1"] and tuple(map(_number, words[:2])) != _USUAL_AIR[: len(words)]:
            yield _AIR, "ENVD"
    for line in configuration_lines(file):
        words = list(line.arguments[3:])
        if line.operand == "PRAM":
            words[1:2] = ["0"]  # which parameter it is
        if all(_says(words, usual) for usual in _OF_CONFIGURATIONS):
            yield "solves and pick-ups of configurations", line.operand
    last = len(file.surfaces) - 1
    for number, block in enumerate(file.surfaces):
        for operand, (group, read, usual) in _OF_SURFACES.items():
            for line in block.get(operand, []):
                if _says(_unread(line, read), usual):
                    yield group, operand
        kind = (block["TYPE"][-1].arguments if "TYPE" in block else ["STANDARD"])[0].upper()
        for line in block.get("PARM", []) if kind in _PARAMETERS else ():
            if _number(line.arguments[0]) not in _PARAMETERS[kind] and _says(
                line.arguments[1:2], ()
            ):
                yield f"numbers that TYPE {kind} does not have", "PARM"
        for operand in ("CURV", "CONI") if kind == "COORDBRK" else ():
            if any(_says(line.arguments[:1], ()) for line in block.get(operand, [])):
                yield f"numbers that TYPE {kind} does not have", operand
        for line in block.get("HIDE", []):
            words = list(line.arguments)
            if 0 < number < last:
                words[_LEAVES_OUT : _LEAVES_OUT + 1] = []
            if _says(words, ()):
                yield _DRAWING, "HIDE"


def _unread(line: Line, read: int) -> list[str]:
    """Return the words that are not read; of a glass without a pick-up that of its surface too."""
    words = line.arguments[read:]
    if line.operand == "GLAS" and line.arguments[1:2] != ["2"]:
        words = [*words, *line.arguments[2:3]]
    return words


def _says(words: list[str], usual: tuple[str, ...]) -> bool:
    """Return whether words are other than the usual ones, and other than nothing behind these."""
    expected = [_number(word) for word in usual]
    given = [_number(word) for word in words]
    behind = given[len(expected) :]
    return given[: len(expected)] != expected[: len(given)] or any(
        w not in _NOTHING for w in behind
    )


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word
