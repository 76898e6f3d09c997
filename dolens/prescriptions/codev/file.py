"""The text of a CODE V `.seq` file is split into commands, which are sorted by system and surface.

A command is a word and its arguments.  A semicolon or a line end ends it, `&` at the end of a line
continues it, `!` begins a remark, and text stands in quotes of either kind.  Only the first three
letters of a longer command count, in any case.  Tables say which commands are read, which bend no
ray, and which are refused.
"""

import re
from dataclasses import dataclass, field
from typing import NamedTuple

from dolens.errors import InputError

# Aperture, fields, wavelengths and surroundings of the system.
SYSTEM = (
    *("TIT", "DIM", "EPD", "FNO", "NA", "NAO", "WL", "REF", "WTW", "TEM", "PRE", "PUI"),
    *("XAN", "YAN", "XOB", "YOB", "XIM", "YIM", "XRI", "YRI", "WTF", "VUX", "VLX", "VUY", "VLY"),
    "TEL",
)
# Of one surface: the one whose lines they follow, or the one that `S4` names.
SURFACE = (
    *("RDY", "CUY", "THI", "GLA", "RMD", "STO", "SLB", "SPH", "CON", "ASP", "K", "PIM"),
    *("A", "B", "C", "D", "E", "F", "G", "H", "J", "CUF", "SPS", "SCO"),
    *("DIF", "HOR", "HWL", "HCT", "HCO"),
    *("CIR", "REX", "REY", "ELX", "ELY", "ADX", "ADY", "ARO"),
    *("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "XOD", "YOD", "ZOD", "DAR", "BEN", "REV"),
)
# What bends no ray, by what it is about; the results of solves and pick-ups are written anyway.
_WITHOUT_EFFECT = {
    "variables, couplings and limits of an optimization": (
        *("CCY", "CCX", "THC", "GLC", "KC", "AC", "BC", "CC", "DC", "EC", "FC", "GC", "HC", "JC"),
        *("CCF", "XDC", "YDC", "ZDC", "ADC", "BDC", "CDC", "HCC", "SCC", "CUM", "THM", "PIK"),
    ),
    "tolerances": (
        *("TDY", "TDX", "TDR", "TDZ", "TTA", "TTB", "TTC", "TIR", "DLF", "DLT", "DLN", "DLV"),
        *("DLZ", "DLA", "DLB", "DLC", "DLX", "DLY", "DLK", "DLR", "DLS", "BTI", "BTX", "BTY"),
        *("TRX", "TRY", "CYD", "CYN", "CYT", "TOL", "COM"),
    ),
    "polarization": ("POL",),
    "coatings, whose .mul files are not read": ("MLT",),
    "settings of the program": ("CA", "CWL", "CLS", "DER", "DOR", "IC", "IFO", "ACO"),
    "": ("INI", "UID", "VIE", "WID"),
}
GROUP_OF = {key: group for group, keys in _WITHOUT_EFFECT.items() for key in keys}
# What bends rays and is not held: three letters → the name that optics gives it.
REFUSED = {
    "CYL": "a cylinder",
    "XTO": "a toroid",
    "YTO": "a toroid",
    "AAS": "an anamorphic asphere",
    "CUX": "a second radius, across x",
    "RDX": "a second radius, across x",
    "SPL": "a spline surface",
    "UDS": "a surface of the user's own program",
    "ZRN": "a Zernike surface",
    "HOE": "a hologram",
    "GRT": "a diffraction grating",
    "GRO": "a diffraction order",
    "GRS": "the spacing of a diffraction grating",
    "GRX": "the direction of a diffraction grating",
    "GRY": "the direction of a diffraction grating",
    "FRN": "a Fresnel lens",
    "LMO": "a lens module",
    "MFL": "the focal length of a lens module",
    "NSS": "a group of non-sequential surfaces",
    "ARR": "an array of surfaces",
    "INT": "an interferogram file on a surface",
    "INS": "a lens inserted from another file",
    "GRN": "a gradient index",
    "GLB": "axes relative to another surface (GLB)",
    "RET": "a return to the axes of another surface (RET)",
    "CIG": "an aperture with its own place",
    "REG": "an aperture with its own place",
    "ELG": "an aperture with its own place",
    "POY": "a polygon as aperture",
    "BIR": "a birefringent medium",
    "APD": "apodization of the pupil",
    "PUX": "the width of a Gaussian beam",
    "PUY": "the width of a Gaussian beam",
    "DST": "a surface with a distribution",
}
# Programs in CODE V's own language begin with these, or with a variable (^x).
MACRO = ("NUM", "STR", "FOR", "IF", "WHI", "EVA", "WRI", "BUF", "LCL", "GBL", "FCT", "RFD", "IN")


# CODE V itself reads far shorter lines; a longer one is no lens.
_LONGEST_LINE = 100_000
_LINE_END = re.compile(r"\r\n|\r|\n")
# A quoted text (an open quote ends with its line), or a word, which may hold one (L'A').
_WORD = re.compile(
    r"""(?P<remark>!.*)|(?P<end>;)|(?P<word>(?:'[^']*(?:'|$)|"[^"]*(?:"|$)|[^\s;!'"])+)"""
)
_SURFACE = re.compile(r"S(O|I|[0-9]+)?")
_NUMBERED = re.compile(r"S(O|I|S|[0-9]+)")
_MOST_SURFACES = 2000
# Variables and functions of macros begin with these.
_VARIABLES = ("^", "@", "(")


class Command(NamedTuple):
    """A `Command` has the number of its line from 1, its key and its arguments.

    Attributes:
        at: number of the line that it begins in.
        key: its word in capitals, cut to three letters; `S`, `SO`, `SI` or `S4` for a surface.
        words: arguments as they are written, with their quotes.
    """

    at: int
    key: str
    words: list[str]


def commands_of(text: str, where: str) -> list[Command]:
    """Split the text of a `.seq` file into commands.

    Raises:
        InputError: a line, with what continues it, is longer than 100 000 letters.
    """
    found: list[Command] = []
    held: list[str] = []
    length, begins = 0, 0
    for at, line in enumerate(_LINE_END.split(text), 1):
        if length + len(line) > _LONGEST_LINE:
            raise InputError(f"{where}: line {at} is longer than {_LONGEST_LINE} letters")
        code = _without_remark(line)
        begins = begins if held else at
        length += len(code)
        if code.endswith("&"):
            held.append(code[:-1] + " ")
            continue
        if held or code:
            found += _commands("".join((*held, code)), begins)
        held, length = [], 0
    return found + _commands("".join(held), begins)


def opening_remarks(text: str) -> str:
    """Return the remarks in front of the first command, a line each."""
    found = []
    for line in _LINE_END.split(text):
        if line.strip() and not line.startswith("!"):
            break
        found.append(line[1:].strip())
    return "\n".join(found).strip()


def unquoted(word: str) -> str:
    """Return a word without the quotes around it."""
    if word[:1] in ("'", '"'):
        return word[1:].removesuffix(word[0])
    return word


def _without_remark(line: str) -> str:
    if "!" not in line:
        return line.rstrip()
    for match in _WORD.finditer(line):
        if match["remark"] is not None:
            return line[: match.start()].rstrip()
    return line.rstrip()


def _commands(line: str, at: int) -> list[Command]:
    found: list[Command] = []
    words: list[str] = []
    for match in _WORD.finditer(line):
        if match["word"] is not None:
            words.append(match["word"])
        if match["end"] is not None and words:
            found.append(_command(at, words))
            words = []
    return [*found, _command(at, words)] if words else found


def _command(at: int, words: list[str]) -> Command:
    key = words[0].upper()
    if _SURFACE.fullmatch(key) is None and key[:1] not in ("'", '"'):
        key = key[:3]
    return Command(at, key, words[1:])


@dataclass
class Block:
    """A `Block` holds what a file says of one surface.

    Attributes:
        label: `SO` for the object, `SI` for the image, `S4` for surface 4.
        at: number of its line.
        radii: whether its first number is a radius and not a curvature; None where the file does
            not say.
        words: the arguments of `S`: radius or curvature, thickness, glass, and how it acts.
        commands: key → commands in their order.
    """

    label: str
    at: int
    radii: bool | None
    words: list[str]
    commands: dict[str, list[Command]] = field(default_factory=dict)

    def said(self, key: str) -> list[str]:
        """Return the arguments of the last command of a key; none where there is none."""
        return self.commands[key][-1].words if key in self.commands else []


@dataclass
class CodeVFile:
    """A `CodeVFile` holds the commands of a file.

    Attributes:
        system: key → commands in their order.
        surfaces: from the object to the image.
        private: name in capitals → the command that gives a private glass its indices.
        wavelengths: of the private glasses, as written.
        zoom: commands about further positions.
        solved: whether the paraxial image solve is on.
        passed_over: what commands that bend no ray are about → their keys.
    """

    system: dict[str, list[Command]] = field(default_factory=dict)
    surfaces: list[Block] = field(default_factory=list)
    private: dict[str, Command] = field(default_factory=dict)
    wavelengths: list[str] = field(default_factory=list)
    zoom: list[Command] = field(default_factory=list)
    solved: bool = False
    passed_over: dict[str, dict[str, None]] = field(default_factory=dict)


def parse_codev(text: str, where: str) -> CodeVFile:
    """Sort the commands of a `.seq` file.

    Raises:
        InputError: a command may bend rays and is not held or known, the file is a macro, it holds
            no surfaces, or these are not in order.
    """
    file = CodeVFile()
    radii: bool | None = None
    private = False
    for command in commands_of(text, where):
        key, words = command.key, command.words
        place = f"{where}: line {command.at}"
        if key[:1] in _VARIABLES or any(word[:1] in _VARIABLES for word in words):
            raise InputError(_macro(command, place))
        if private:
            private = key != "END"
            _private(file, command, place)
        elif key == "PRV":
            private = True
        elif key == "GO":
            break
        elif key == "LEN":
            if file.surfaces:
                raise InputError(f"{place}: LEN begins a second lens; a file may hold one")
        elif key == "RDM":
            radii = not words or not words[0].upper().startswith("N")
        elif key == "ZOO":
            file.zoom.append(command)
        elif _is_surface(key):
            _begin(file, command, radii, place)
        elif key == "PIM":
            file.solved = not words or not words[0].upper().startswith("N")
        elif key in SURFACE:
            _add(file, command, place)
        elif key in SYSTEM:
            file.system.setdefault(key, []).append(command)
        else:
            group = GROUP_OF.get(key)
            if group is None:
                raise InputError(_refusal(command, place))
            file.passed_over.setdefault(group, {})[key] = None
    labels = [block.label for block in file.surfaces]
    if labels[:1] != ["SO"] or labels[-1:] != ["SI"] or len(labels) < 3:
        raise InputError(f"{where}: needs an object (SO), surfaces (S) and an image (SI), in order")
    return file


def _is_surface(key: str) -> bool:
    return key == "S" or (key != "SS" and _NUMBERED.fullmatch(key) is not None)


def _begin(file: CodeVFile, command: Command, radii: bool | None, place: str) -> None:
    """Begin the block of the next surface, or go back to one by its number."""
    number = len(file.surfaces)
    if number and file.surfaces[-1].label == "SI":
        raise InputError(f"{place}: {command.key} stands behind the image surface (SI)")
    allowed = ("S", f"S{number}", "SI") if number else ("SO", "S0")
    if command.key not in allowed:
        raise InputError(f"{place}: expected {' or '.join(allowed)}, not {command.key}")
    label = "SI" if command.key == "SI" else f"S{number}" if number else "SO"
    if number > _MOST_SURFACES:
        raise InputError(f"{place}: more than {_MOST_SURFACES} surfaces")
    file.surfaces.append(Block(label, command.at, radii, command.words))


def _add(file: CodeVFile, command: Command, place: str) -> None:
    """Add a command to the surface that it names, or to the last one."""
    words = command.words
    named = words[0].upper() if words else ""
    if _NUMBERED.fullmatch(named):
        chosen = [block for block in file.surfaces if block.label == named.replace("S0", "SO")]
        if not chosen:
            raise InputError(f"{place}: {command.key} names {named}, which the file does not have")
        chosen[0].commands.setdefault(command.key, []).append(command._replace(words=words[1:]))
        return
    if named.startswith("S") and ".." in named:
        raise InputError(f"{place}: {command.key} of several surfaces ({named}); write one each")
    if not file.surfaces:
        raise InputError(f"{place}: {command.key} stands before the first surface")
    file.surfaces[-1].commands.setdefault(command.key, []).append(command)


def _private(file: CodeVFile, command: Command, place: str) -> None:
    """Note the wavelengths or one glass of a private catalogue."""
    if command.key == "PWL":
        file.wavelengths = command.words
    elif command.key[:1] in ("'", '"'):
        file.private[command.key.strip("'\"").upper()] = command
    elif command.key != "END":
        raise InputError(
            f"{place}: {command.key} in a private catalogue (PRV) is not held (allowed: PWL, and a "
            "glass by its name in quotes)"
        )


def _refusal(command: Command, place: str) -> str:
    key = command.key
    if key in MACRO:
        return _macro(command, place)
    if key in REFUSED:
        shown = " ".join((key, *command.words[:1]))
        return f"{place}: {shown}: {REFUSED[key]} is not held"
    return f"{place}: command {key} is not known, and may bend rays"


def _macro(command: Command, place: str) -> str:
    return (
        f"{place}: is a macro of CODE V ({command.key}), no lens; save the lens as .seq in CODE V"
    )
