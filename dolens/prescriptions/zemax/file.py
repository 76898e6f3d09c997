"""Operands of Zemax `.zmx` files are sorted line by line, and their numbers read in mm.

A file is a list of lines, each an operand of capital letters and its arguments.  The first ones
describe the system; from `SURF n` on they describe surface n, usually indented.  Surface 0 is the
object, the last one the image.  The merit function, tolerances and configurations may follow.

Programs of thirty years have written these files, each with operands of its own.  What changes the
way of light is a closed table (`SURFACE_OPERANDS`, `SYSTEM_OPERANDS`); every other operand is
passed over, and counted.

`CURV 0.02 0 0 0 0 ""` gives a curvature and how it is solved for; only the number is read.  `PARM n
value` and `XDAT n value` are the numbers of a shape, of which each TYPE has a list of its own.
"""

import codecs
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number, number_in_text, scaled

# What a surface's block may say about the way of light.
SHAPE_OPERANDS = ("TYPE", "CURV", "CONI", "PARM", "XDAT", "DISZ", "GLAS")
SURFACE_OPERANDS = (
    *("STOP", "COMM", *SHAPE_OPERANDS, "HIDE", "SCBD", "GDAT", "GARR", "COAT"),
    *("DIAM", "CLAP", "FLAP", "SQAP", "ELAP", "OBSC", "SQOB", "ELOB", "SPID", "OBDC"),
    *("USAP", "USOB", "UDAD"),
)
# What a surface's block may say and bends no ray.  Others are passed over too, but where nothing is
# indented only these are known to belong to a surface.
UNREAD_OF_SURFACES = (
    *("SSID", "FIMP", "MIRR", "SLAB", "MEMA", "OEMA", "POPS", "SCAT", "SCOL", "BORD"),
    *("DRAW", "EDGE", "EDGV", "MAZH", "MAZA", "CHZH", "CHZA", "PZUP", "PPAR", "PKUP", "VDSZ"),
    *("VCON", "VPAR", "TOLE", "TCOM", "TCED", "TCEX", "TCE", "BOOK", "RAYS", "UNIF", "QTYP"),
)
# What describes the whole system: title, unit, air, aperture, fields, wavelengths.
SYSTEM_OPERANDS = (
    *("MODE", "NAME", "NOTE", "UNIT", "GCAT", "ENVD"),
    *("ENPD", "FNUM", "OBNA", "FLOA", "RAIM"),
    *("FTYP", "XFLN", "YFLN", "XFLD", "YFLD", "FWGN", "FWGT", "FENF", "FEFD"),
    *("VDXN", "VDYN", "VCXN", "VCYN", "VANN", "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN"),
    *("WAVM", "WAVL", "WAVN", "WWGT", "WWGN", "PWAV"),
    "MNUM",
)
# As many as a lens may have.
_MOST_SURFACES = 10_000
# Not str.splitlines: it also breaks at letters that Latin-1 text may hold.
_LINE_END = re.compile(r"\r\n|\r|\n")
# The text of a zero that a writer gives a coefficient which a prescription names.  Zemax lists
# zeros (`0`, `0.000000000000E+000`) of all coefficients, named or not.
NAMED_ZERO = "0.0"
# A node's numbers, and the powers of a length that they are.
_NODE = {"sag": 1, "slope_x": 0, "slope_y": 0, "twist": -1}


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
        system: operand → its lines, of the operands of the system.
        surfaces: the same for each surface, from the object to the image.
        tail: the lines behind the surfaces: merit function, tolerances, configurations.
        passed_over: operand → its lines in the system and the surfaces, which are not read.
        skipped: numbers of surfaces that the file leaves out.
    """

    system: dict[str, list[Line]] = field(default_factory=dict)
    surfaces: list[dict[str, list[Line]]] = field(default_factory=list)
    tail: list[Line] = field(default_factory=list)
    passed_over: dict[str, list[Line]] = field(default_factory=dict)
    skipped: list[int] = field(default_factory=list)

    def configuration_lines(self) -> list[Line]:
        """Return the lines behind MNUM that set something, of all configurations."""
        begin = self.system.get("MNUM")
        if not begin:
            return []
        return [line for line in self.tail if line.at > begin[-1].at and line.operand != "MOFF"]


def encode_zemax(text: str) -> bytes:
    """Encode a `.zmx` file with Zemax's line ends: ASCII where that is enough, else UTF-16."""
    text = _LINE_END.sub("\r\n", text)
    if text.isascii():
        return text.encode("ascii")
    return codecs.BOM_UTF16_LE + text.encode("utf-16-le")


def _check_number(file: ZemaxFile, line: Line, where: str) -> None:
    """Check that a surface has the number that is due.

    Some programs skip a number, which leaves a plane of no thickness in air: that must be what it
    would be, with air before it.
    """
    expected = len(file.surfaces) + len(file.skipped)
    number = line.arguments[0] if line.arguments else ""
    if number == str(expected):
        return
    skips = number == str(expected + 1) and file.surfaces and "GLAS" not in file.surfaces[-1]
    if not skips:
        raise InputError(f"{where}: line {line.at}: expected SURF {expected}, not 'SURF {number}'")
    file.skipped.append(expected)


def parse_zemax(text: str, where: str) -> ZemaxFile:
    """Sort the lines of a file by surface and operand.

    A surface's block reaches as far as lines are indented more than its SURF; behind it, operands
    of surfaces still belong to it, since some programs indent nothing.

    Raises:
        InputError: surfaces are not numbered from 0, or the shape of a surface is spoken of behind
            the last one.
    """
    file = ZemaxFile()
    block: dict[str, list[Line]] | None = None
    margin = 0
    for at, raw in enumerate(_LINE_END.split(text), 1):
        words = raw.split()
        if not words:
            continue
        line = Line(at, words[0].upper(), words[1:], raw.strip()[len(words[0]) :].strip())
        indent = len(raw) - len(raw.lstrip())
        if line.operand == "SURF":
            _check_number(file, line, where)
            if len(file.surfaces) > _MOST_SURFACES:
                raise InputError(f"{where}: line {at}: more than {_MOST_SURFACES} surfaces")
            block, margin = {}, indent
            file.surfaces.append(block)
        elif block is not None and line.operand in SURFACE_OPERANDS:
            block.setdefault(line.operand, []).append(line)
        elif line.operand in SYSTEM_OPERANDS:
            file.system.setdefault(line.operand, []).append(line)
            block = block if indent > margin else None
        elif not file.surfaces or (
            block is not None and (indent > margin or line.operand in UNREAD_OF_SURFACES)
        ):
            file.passed_over.setdefault(line.operand, []).append(line)
        elif line.operand in SHAPE_OPERANDS:
            raise InputError(f"{where}: line {at}: {line.operand} stands behind the surfaces")
        else:
            file.tail.append(line)
            block = None
    return file


@dataclass(frozen=True)
class SurfaceBlock:
    """A `SurfaceBlock` holds the lines of one surface.

    Attributes:
        lines: operand → its lines.
        factor: mm in the file's unit of length.
        place: name of the surface in messages.
        before: the medium before it, as a prescription writes it.
        material: the medium behind it.
        stop: whether it is the stop.
    """

    lines: Mapping[str, list[Line]]
    factor: Fraction
    place: str
    before: str = "air"
    material: str = "air"

    @property
    def stop(self) -> bool:
        """Return whether the file says STOP here."""
        return "STOP" in self.lines

    def words(self, operand: str) -> list[str]:
        """Return the arguments of an operand's last line; none where it has no line."""
        return self.lines[operand][-1].arguments if operand in self.lines else []

    def number(self, operand: str) -> float:
        """Return the first argument of an operand, 0 where it has none.

        Raises:
            InputError: it is no finite number.
        """
        return number_in_text((self.words(operand) or ["0"])[0], f"{self.place}: {operand}")

    def length(self, operand: str, power: int = 1) -> float:
        """Return the first argument of an operand, a length to a power, in mm^power."""
        word = (self.words(operand) or ["0"])[0]
        return scaled(word, self.factor**power, f"{self.place}: {operand}")

    @property
    def type(self) -> str:
        """Return the word behind TYPE in capitals; a file that does not say it means STANDARD."""
        return (self.words("TYPE") or ["STANDARD"])[0].upper()

    @property
    def curvature(self) -> float:
        """Return the curvature, 1/mm."""
        return self.length("CURV", -1)

    @cached_property
    def slots(self) -> dict[str, str]:
        """Return the numbers of PARM and XDAT as they are written, by slot: `PARM 2`, `XDAT 3`."""
        found = {}
        for operand in ("PARM", "XDAT"):
            for line in self.lines.get(operand, []):
                what = f"{self.place}: {operand} (line {line.at})"
                if len(line.arguments) < 2:
                    raise InputError(f"{what}: needs a number from 1 and a value")
                n = number_in_text(line.arguments[0], what)
                if n < 0 or n != int(n):
                    raise InputError(
                        f"{what}: must have a whole number from 0, not {line.arguments[0]}"
                    )
                number_in_text(line.arguments[1], what)
                found[f"{operand} {int(n)}"] = line.arguments[1]
        return found

    def slot(self, name: str, power: int = 0) -> float:
        """Return a number of PARM or XDAT, a length to a power, in mm^power; 0 where the file does
        not give it.
        """
        return scaled(self.slots.get(name, "0"), self.factor**power, f"{self.place}: {name}")


def read_grid(block: SurfaceBlock) -> dict[str, Any]:
    """Return spacings, sags and slopes of a grid of sags (mm), by the names of a row.

    GDAT has the numbers of columns and rows, and their spacings; `GARR n sag slope slope twist
    flag` is a node, row after row from +y to -y, and within a row from -x to +x.  Where all slopes
    are zero they are not given, and come from splines.

    Raises:
        InputError: a number or a node is missing, or the grid is decentred.
    """
    what = f"{block.place}: GDAT"
    words = block.words("GDAT")
    if len(words) < 4:
        raise InputError(f"{what}: needs columns, rows and two spacings")
    columns, rows = (number_in_text(word, what) for word in words[:2])
    if min(columns, rows) < 2 or columns != int(columns) or rows != int(rows):
        raise InputError(f"{what}: needs 2 or more columns and rows, not {words[0]} × {words[1]}")
    if any(number_in_text(word, what) != 0.0 for word in words[4:6]):
        raise InputError(f"{what}: a grid that is decentred is not held")
    spacing_x, spacing_y = (scaled(word, block.factor, what) for word in words[2:4])
    found: dict[str, Any] = {"spacing_x": spacing_x, "spacing_y": spacing_y}
    nodes = _nodes(block, int(columns), int(rows))
    sloped = any(any(node[1:]) for row in nodes for node in row)
    for place, name in enumerate(_NODE if sloped else ("sag",)):
        found[name] = [[node[place] for node in row] for row in reversed(nodes)]
    return found


def _nodes(block: SurfaceBlock, columns: int, rows: int) -> list[list[list[float]]]:
    """Return the numbers of each node, row after row from +y to -y."""
    given = block.lines.get("GARR", [])
    if columns * rows > len(given):
        raise InputError(
            f"{block.place}: GDAT names {columns} × {rows} nodes, and {len(given)} have a GARR"
        )
    nodes: list[list[float] | None] = [None] * (columns * rows)
    for line in given:
        what = f"{block.place}: GARR (line {line.at})"
        if len(line.arguments) < 5:
            raise InputError(f"{what}: needs a number, sag, two slopes and the twist")
        node = number_in_text(line.arguments[0], what)
        if not 0 <= node < len(nodes) or node != int(node):
            raise InputError(f"{what}: must be a node from 0 to {len(nodes) - 1}, not {node:g}")
        if any(float(word) != 0.0 for word in line.arguments[5:6]):
            raise InputError(f"{what}: node {node:g} has no data, which is not held")
        words = zip(line.arguments[1:5], _NODE.values(), strict=True)
        nodes[int(node)] = [scaled(word, block.factor**power, what) for word, power in words]
    full = [node for node in nodes if node is not None]
    if len(full) < len(nodes):
        missing = len(nodes) - len(full)
        raise InputError(f"{block.place}: {missing} of {len(nodes)} nodes have no GARR")
    return [full[columns * j : columns * (j + 1)] for j in range(rows)]


def grid_lines(row: Mapping[str, Any], place: str) -> list[str]:
    """Return the lines that `read_grid` reads back."""
    sag = row["sag"]
    sizes = [as_number(row.get(name), place) for name in ("spacing_x", "spacing_y")]
    lines = [f"GDAT {len(sag[0])} {len(sag)} {sizes[0]!r} {sizes[1]!r} 0 0"]
    arrays = [row.get(name) for name in _NODE]
    nodes = [(j, i) for j in reversed(range(len(sag))) for i in range(len(sag[0]))]
    for n, (j, i) in enumerate(nodes):
        numbers = [0.0 if a is None else as_number(a[j][i], place) for a in arrays]
        lines.append(f"GARR {n} {' '.join(map(repr, numbers))} 0")
    return lines
