"""The commands of a CODE V `.seq` file are sorted by system and surface."""

import re
from dataclasses import dataclass, field

from dolens.errors import InputError
from dolens.prescriptions.codev.keys import GROUP_OF, MACRO, REFUSED, SURFACE, SYSTEM
from dolens.prescriptions.codev.text import Command, commands_of

_NUMBERED = re.compile(r"S(O|I|S|[0-9]+)")
_MOST_SURFACES = 2000
# Variables and functions of macros begin with these.
_VARIABLES = ("^", "@", "(")


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
