"""Zemax `.zmx` files are decoded, and their operands sorted line by line.

A file is a list of lines, each an operand of capital letters and its arguments.  The first ones
describe the system; from `SURF n` on they describe surface n, usually indented.  Surface 0 is the
object, the last one the image.  Merit functions and tolerances may follow.
"""

import codecs
import re
from dataclasses import dataclass, field
from typing import NamedTuple

from dolens.errors import InputError

# What a surface's block may say and a prescription holds.
HELD = (
    *("TYPE", "COMM", "STOP", "CURV", "CONI", "PARM", "DISZ", "GLAS"),
    *("DIAM", "CLAP", "FLAP", "SQAP", "OBSC", "SQOB", "OBDC"),
)
# What bends no ray: drawing, coatings, mechanical size, and solves whose result is written anyway.
WITHOUT_EFFECT = (
    *("FIMP", "HIDE", "MIRR", "SLAB", "POPS", "MEMA", "OEMA", "COAT", "BORD", "DRAW", "SCAT"),
    *("TCEX", "TCE", "MAZH", "MAZA", "CHZH", "CHZA", "EDGE", "EDGV", "PIKC", "PIKT", "PIKD"),
    *("PIKG", "PIKK", "PIKP", "PZUP", "RAYS", "UNIF", "QTYP"),
)
# Not str.splitlines: it also breaks at letters that Latin-1 text may hold.
_LINE_END = re.compile(r"\r\n|\r|\n")


class Line(NamedTuple):
    """A `Line` has its number in the file from 1, its operand, arguments, and the text behind
    it.
    """

    at: int
    operand: str
    arguments: list[str]
    text: str


@dataclass
class ZemaxFile:
    """A `ZemaxFile` holds the lines of a file.

    Attributes:
        system: operand → its lines, before and after the surfaces.
        surfaces: the same for each surface, from the object to the image.
    """

    system: dict[str, list[Line]] = field(default_factory=dict)
    surfaces: list[dict[str, list[Line]]] = field(default_factory=list)


def decode_zemax(data: bytes, where: str = "lens") -> str:
    """Decode a `.zmx` file: UTF-16 or UTF-8, with a byte order mark or without, or Latin-1.

    Raises:
        InputError: the file is no text.
    """
    encoding = "utf-8"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif data.startswith(codecs.BOM_UTF8):
        encoding = "utf-8-sig"
    elif data[1:2] == b"\0":  # the first letter, in 16 bits
        encoding = "utf-16-le"
    elif data[:1] == b"\0":
        encoding = "utf-16-be"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise InputError(f"{where}: is not valid {encoding.upper()} text") from None
        text = data.decode("latin-1")
    if "\0" in text:
        raise InputError(f"{where}: is no text (allowed: UTF-16, UTF-8 or Latin-1)")
    return text


def encode_zemax(text: str) -> bytes:
    """Encode a `.zmx` file with Zemax's line ends: ASCII where that is enough, else UTF-16."""
    text = _LINE_END.sub("\r\n", text)
    if text.isascii():
        return text.encode("ascii")
    return codecs.BOM_UTF16_LE + text.encode("utf-16-le")


def parse_zemax(text: str, where: str) -> ZemaxFile:
    """Sort the lines of a file by surface and operand.

    Raises:
        InputError: a surface's block holds an operand that may bend rays and is not known, or
            surfaces are not numbered from 0.
    """
    file = ZemaxFile()
    block = file.system
    for at, raw in enumerate(_LINE_END.split(text), 1):
        words = raw.split()
        if not words:
            continue
        line = Line(at, words[0].upper(), words[1:], raw.strip()[len(words[0]) :].strip())
        if line.operand == "SURF":
            expected = str(len(file.surfaces))
            if line.arguments[:1] != [expected]:
                raise InputError(
                    f"{where}: line {at}: expected SURF {expected}, not '{raw.strip()}'"
                )
            block = {}
            file.surfaces.append(block)
        elif block is not file.system and line.operand not in HELD:
            if line.operand in WITHOUT_EFFECT:
                continue
            if raw[0].isspace():
                place = f"{where}: surface {len(file.surfaces) - 1}: operand {line.operand}"
                raise InputError(f"{place} (line {at}) is not held (allowed: {', '.join(HELD)})")
            # What is not indented and no property of a surface ends the surfaces.
            block = file.system
        block.setdefault(line.operand, []).append(line)
    return file
