"""Operands and numbers of a Zemax `.zmx` file that no lens needs are listed in words.

`CURV 0.02 1 0 0 0 ""` is a curvature, and that an optimizer may change it.  What follows a number
is mostly as programs write it in every file; where it is not, it says something that is not read.
"""

from collections.abc import Callable, Iterator
from itertools import zip_longest

from dolens.errors import InputError
from dolens.prescriptions.numbers import number_in_text
from dolens.prescriptions.zemax.file import Line, ZemaxFile
from dolens.prescriptions.zemax.shapes import JONES_MATRIX

_SOLVES = "variables and solves, whose results are written"
_DRAWING = "drawing and colours"
_APERTURES = "further numbers of apertures"
_FIELDS = "settings of fields"
_AIR = "temperature and pressure, which the indices do not follow"
_SYSTEM = "further numbers of the system"
_AIMING = "ray aiming, which is always on here"
_NOTHING = (0.0, '""')

# Operand of a surface → what its further words are about, how many words are read, and what
# programs always write behind them; after that, zeros and empty texts.
_NUMBERS_OF_SURFACES: dict[str, tuple[str, int, tuple[str, ...]]] = {
    **{key: (_SOLVES, 1, ()) for key in ("CURV", "CONI", "DISZ")},
    "PARM": (_SOLVES, 2, ()),
    "XDAT": (_SOLVES, 2, ("0", "0", "1")),
    **{key: (_APERTURES, 2, ()) for key in ("CLAP", "FLAP", "SQAP", "ELAP", "OBSC", "SQOB")},
    **{key: (_APERTURES, 2, ()) for key in ("ELOB", "SPID", "OBDC")},
    **{key: (_APERTURES, 0, ()) for key in ("USAP", "USOB")},
    "DIAM": (_APERTURES, 2, ("0", "0", "1")),
    "GLAS": (_SOLVES, 6, ()),
}
_NUMBERS_OF_THE_SYSTEM: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "ENPD": (_SYSTEM, 1, ()),
    "FNUM": (_SYSTEM, 2, ()),
    "OBNA": (_SYSTEM, 2, ()),
    "PWAV": (_SYSTEM, 1, ()),
    "WAVM": (_SYSTEM, 3, ()),
    "FTYP": (_FIELDS, 4, ()),
    "RAIM": (_AIMING, 2, ("1", "1", "0", "0", "0", "0", "0", "1")),
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
# Operands that are not read, by what they are about.  They bend no ray.
_GROUPS = {
    _DRAWING: ("MIRR", "SLAB", "SCOL", "DRAW", "SSID", "BOOK", "LAYR", "SUBS"),
    "mechanical sizes": ("MEMA", "OEMA", "BORD", "MECH", "TPDR"),
    "scatter models": ("SCAT", "SCSF"),
    "physical optics": ("POPS", "POPD"),
    _SOLVES: (
        *("VDSZ", "VCON", "VPAR", "VCUR", "VXDT", "PPAR", "PZUP", "PKUP", "PCON", "PXDT", "PIKC"),
        *("MAZH", "MAZA", "CHZH", "CHZA", "EDGE", "EDGV", "OPDS", "PIKT", "PIKD", "PIKG", "PIKK"),
        *("PIKP", "POSI", "COMP", "COCU", "PUPS", "EVAL", "ZPLM", "TZPL", "CZPL", "XZPL"),
        *("FSVX", "FSVY"),
    ),
    "expansion with temperature": ("TCED", "TCEX", "TCE"),
    "tolerances": ("TOLE", "TCOM", "UNIF", "QTYP"),
    "files of its own": ("FIMP", "RAYS"),
    "apodization": ("GFAC",),
    "polarization": ("POLS",),
    _AIMING: ("RAIM", "PUSH", "XAIM", "YAIM", "ZAIM"),
    "coating and scatter files": ("COFN", "IWDP"),
    "settings of the program": (
        *("VERS", "PFIL", "LANG", "ROPD", "PICB", "SDMA", "GLRS", "GSTD", "NSCD", "HYPR", "OMMA"),
        *("AUTH", "LUID", "EERA", "STUD", "FCOM", "DBDT", "CSUM", "PUPD", "SDIA"),
    ),
}
_GROUP_OF = {operand: group for group, operands in _GROUPS.items() for operand in operands}
_UNKNOWN = "operands unknown here"
# What stands there in every file: no physical optics, and light that is not polarized.
_USUAL_POPS = (*(0.0,) * 8, *(1.0,) * 4)
_USUAL_POLS = (1.0, 0.0, 1.0, 0.0, 0.0, 1.0)
# Said of every file, and of no lens.
_SILENT = ("settings of the program", "coating and scatter files", "mechanical sizes")


def _further_numbers(file: ZemaxFile) -> Iterator[tuple[str, str]]:
    """Yield what such numbers are about, and their operand, of all that say something."""
    for operand, (group, read, usual) in _NUMBERS_OF_THE_SYSTEM.items():
        for line in file.system.get(operand, []):
            words = line.arguments[read:]
            if operand == "FTYP" and words[3:4] == line.arguments[2:3]:
                words = [*words[:3], *words[4:]]  # the count of fields once more
            if _says(words, usual):
                yield group, operand
    for line in file.system.get("ENVD", []):
        words = line.arguments
        if (
            words[2:3] != ["1"]
            and tuple(map(_number_or_word, words[:2])) != _USUAL_AIR[: len(words)]
        ):
            yield _AIR, "ENVD"
    for line in file.configuration_lines():
        words = list(line.arguments[3:])
        if line.operand == "PRAM":
            words[1:2] = ["0"]  # which parameter it is
        if all(_says(words, usual) for usual in _OF_CONFIGURATIONS):
            yield "solves and pick-ups of configurations", line.operand
    last = len(file.surfaces) - 1
    for number, block in enumerate(file.surfaces):
        for operand, (group, read, usual) in _NUMBERS_OF_SURFACES.items():
            for line in block.get(operand, []):
                if _says(_unread(line, read), usual):
                    yield group, operand
        kind = (block["TYPE"][-1].arguments if "TYPE" in block else ["STANDARD"])[0].upper()
        for line in block.get("PARM", []) if kind in _PARAMETERS else ():
            if _number_or_word(line.arguments[0]) not in _PARAMETERS[kind] and _says(
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
    expected = [_number_or_word(word) for word in usual]
    given = [_number_or_word(word) for word in words]
    behind = given[len(expected) :]
    return given[: len(expected)] != expected[: len(given)] or any(
        w not in _NOTHING for w in behind
    )


def _number_or_word(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _first_number(line: Line) -> bool:
    return bool(line.arguments) and _number(line.arguments[0]) != 0.0


def _any_number(line: Line) -> bool:
    return any(_number(word) for word in line.arguments)


def _differs(line: Line, usual: tuple[float, ...]) -> bool:
    """Return whether numbers are not the usual ones, and zeros behind these."""
    found = [_number(word) for word in line.arguments]
    return any(a != b for a, b in zip_longest(found, usual[: len(found)], fillvalue=0.0))


# Lines that are always there, and which of them say anything.
_SAYS: dict[str, Callable[[Line], bool]] = {
    "GFAC": _any_number,
    "SCAT": lambda line: bool(line.text),
    "FIMP": lambda line: bool(line.text),
    "POPS": lambda line: _differs(line, _USUAL_POPS),
    "POLS": lambda line: _differs(line, _USUAL_POLS),
    "RAIM": lambda line: any(map(_number, line.arguments[:2])),
    "PUSH": _any_number,
    "SCOL": _first_number,
}


def passed_over(file: ZemaxFile) -> list[str]:
    """Return what a file says that is not read and bends no ray, in words.

    Each entry names a group, and the operands behind it.  The program's own settings and sizes
    for drawing, which all files have, are left out.
    """
    groups: dict[str, dict[str, None]] = {}
    aiming = {"RAIM": file.system["RAIM"]} if "RAIM" in file.system else {}
    for operand, lines in (*aiming.items(), *file.passed_over.items()):
        says = _SAYS.get(operand, lambda line: True)
        group = _GROUP_OF.get(operand, _UNKNOWN)
        if group not in _SILENT and any(says(line) for line in lines):
            groups.setdefault(group, {})[operand] = None
    for group, operand in _further_numbers(file):
        groups.setdefault(group, {})[operand] = None
    for number, block in enumerate(file.surfaces):
        if any(line.arguments[:1] == [JONES_MATRIX.type] for line in block.get("TYPE", [])):
            groups.setdefault(f"polarization: the Jones matrix of surface {number}", {})
    for number in file.skipped:
        groups.setdefault(f"surface {number}, which the file leaves out", {})
    for group in (*_opd_modes(file), *_behind_the_surfaces(file)):
        groups.setdefault(group, {})
    return [
        f"{group} ({', '.join(operands)})" if operands else group
        for group, operands in groups.items()
    ]


def _opd_modes(file: ZemaxFile) -> list[str]:
    """Return which paraxial lenses have an OPD mode other than 0 (PARM 2).

    It says what the paths of light through an ideal lens are computed from: conjugates found by a
    real ray (0) or a paraxial one (3), infinite conjugates (2), or the phase of each ray (1).  It
    turns no ray.
    """
    found = []
    for number, lines in enumerate(file.surfaces):
        kind = lines["TYPE"][-1].arguments[:1] if "TYPE" in lines else []
        modes = [line for line in lines.get("PARM", []) if line.arguments[:1] == ["2"]]
        if kind == ["PARAXIAL"] and modes and _number((*modes[-1].arguments, "0")[1]) != 0.0:
            found.append(
                f"surface {number}: the OPD mode of a paraxial lens, whose paths are here those "
                "between its conjugates"
            )
    return found


def _behind_the_surfaces(file: ZemaxFile) -> list[str]:
    """Return which of merit function and tolerances the lines behind the surfaces hold."""
    found: dict[str, None] = {}
    begin = file.system.get("MNUM")
    for line in file.tail:
        if line.operand == "TOL":
            if line.arguments[:1] not in ([], ["TOFF"]):
                found["tolerances"] = None
        elif begin and line.at > begin[-1].at:
            break
        elif line.operand not in ("TCMM", "CSUM", "BLNK") or (line.operand == "BLNK" and line.text):
            found["the merit function"] = None
    return list(found)


def _number(word: str) -> float:
    try:
        return number_in_text(word, "")
    except InputError:
        return 0.0
