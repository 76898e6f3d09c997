"""The text of a CODE V `.seq` file is split into commands; what they mean is found elsewhere.

A command is a word and its arguments.  A semicolon or a line end ends it, `&` at the end of a line
continues it, `!` begins a remark, and text stands in quotes of either kind.  Only the first three
letters of a longer command count, in any case.
"""

import re
from typing import NamedTuple

from dolens.errors import InputError

# CODE V itself reads far shorter lines; a longer one is no lens.
_LONGEST_LINE = 100_000
_LINE_END = re.compile(r"\r\n|\r|\n")
# A quoted text (an open quote ends with its line), or a word, which may hold one (L'A').
_WORD = re.compile(
    r"""(?P<remark>!.*)|(?P<end>;)|(?P<word>(?:'[^']*(?:'|$)|"[^"]*(?:"|$)|[^\s;!'"])+)"""
)
_SURFACE = re.compile(r"S(O|I|[0-9]+)?")


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
