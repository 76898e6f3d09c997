"""Zemax's coating files (COATING.DAT) are read as a prescription writes coatings.

Such a file is a list of blocks; `!` begins a remark, and names have any case::

    MATE name                   # a material: µm, n, and the imaginary part of n - ik
    0.55 2.05 -0.001
    COAT name                   # a stack: material, thickness, absolute, loop, taper
    NAME 0.25                   # waves of the primary wavelength in the film: T·λ/n(λ)
    NAME 0.0962 1               # µm
    IDEAL name T R              # shares of power
    IDEAL2 name s_rr s_ri s_tr s_ti p_rr p_ri p_tr p_ti flag     # amplitudes, as shares |r|², |t|²
    TABLE name                  # shares by angle and wavelength, and phases, which are not held
    ANGL 0
    WAVE 0.55 Rs Rp Ts Tp Ars Arp Ats Atp

Zemax's phase is exp(i(ωt - kz)): an absorbing film has a negative imaginary part.  Between rows all
is linear, and beyond the first and last row their values hold.  A stack is listed from the
outermost layer to the substrate.  The layers from one with a loop number to the next one with the
same are there that many times.

Source: OpticStudio's help, "Defining Coatings", "The COAT Data Section" and "The TABLE Data
Section".
"""

import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.files import decode_text, read_file
from dolens.optics.dispersion import LONGEST, SHORTEST
from dolens.prescriptions.numbers import number_in_text, scaled

# A coating file of a maker has some hundred kB.
_LARGEST = 32 * 2**20
_BLOCKS = ("MATE", "TAPR", "COAT", "IDEAL", "IDEAL2", "TABLE", "ENCRYPTED")
_NM = Fraction(1000)
# Layers of a stack with its repetitions.
_MOST_LAYERS = 1000
# The wavelength (nm) of a row that holds at all.
_WAVELENGTH = 550.0


class Block(NamedTuple):
    """A `Block` of a coating file is its keyword, what stands behind it, and its lines.

    Attributes:
        kind: the keyword.
        words: behind it.
        lines: number and words of each line below it.
        at: number of its own line.
    """

    kind: str
    words: list[str]
    lines: list[tuple[int, list[str]]]
    at: int


class CoatingFile(NamedTuple):
    """A `CoatingFile` has materials and coatings by their names in capitals; of some, several."""

    path: Path
    materials: dict[str, list[Block]]
    coatings: dict[str, list[Block]]


def parse_coatings(text: str, path: Path) -> CoatingFile:
    """Sort the lines of a coating file by its blocks, which are not looked at yet.

    Raises:
        InputError: there is no block.
    """
    file = CoatingFile(path, {}, {})
    block = None
    for at, raw in enumerate(re.split(r"\r\n|\r|\n", text), 1):
        words = raw.partition("!")[0].split()
        if not words:
            continue
        kind = words[0].upper()
        if kind in _BLOCKS:
            block = Block(kind, words[1:], [], at)
            named = file.materials if kind == "MATE" else file.coatings
            if kind != "TAPR" and words[1:]:
                named.setdefault(words[1].upper(), []).append(block)
        elif block is not None:
            block.lines.append((at, words))
    if block is None:
        raise InputError(f"{path}: is no coating file (it has none of {', '.join(_BLOCKS)})")
    return file


class Read(NamedTuple):
    """A `Read` coating is what one of a file is in a prescription.

    Attributes:
        layers: of a stack, from the outermost to the substrate; None of others.
        table: rows [nm, degrees, R_s, R_p, T_s, T_p] of others.
        notes: what of it is not read, in words.
    """

    layers: list[dict[str, Any]] | None = None
    table: Sequence[Sequence[float]] = ()
    notes: Sequence[str] = ()


def coating_file(path: Path) -> CoatingFile:
    """Read a coating file; one that has not changed is not read again.

    Raises:
        InputError: it is missing, or no coating file.
    """
    state = path.stat()
    return _parsed(path, state.st_mtime_ns, state.st_size)


# The time and size of the file are part of the key: an edited file is read again.
@lru_cache(maxsize=16)
def _parsed(path: Path, changed: int, size: int) -> CoatingFile:
    return parse_coatings(decode_text(read_file(path, _LARGEST, "coating file"), str(path)), path)


def shares_everywhere(r_s: float, r_p: float, t_s: float, t_p: float) -> list[list[float]]:
    """Return the table of shares that hold at all wavelengths and angles."""
    return [[_WAVELENGTH, 0.0, r_s, r_p, t_s, t_p]]


def read_coating(file: CoatingFile, name: str, waves: Sequence[float], place: str) -> Read:
    """Return a coating of a file.

    Args:
        file: it has a coating of that name.
        name: in any case.
        waves: of the lens, nm; the primary one is the first.
        place: begins messages.

    Raises:
        InputError: the coating is encrypted, tapers or amplifies, names no material of the file, or
            its numbers are none; one line that names the line.
    """
    block = _only(file.coatings[name.upper()], place)
    if block.kind == "ENCRYPTED":
        raise InputError(f"{place} is encrypted; ask its maker for a TABLE or its layers")
    if block.kind == "IDEAL":
        passed, reflected = _numbers(block.words[1:], 2, place)
        return Read(table=shares_everywhere(reflected, reflected, passed, passed))
    phases = [f"phases of the coating {name}, whose shares are read"]
    if block.kind == "IDEAL2":
        parts = _numbers(block.words[1:], 8, place)
        pairs = list(zip(parts[::2], parts[1::2], strict=True))
        r_s, t_s, r_p, t_p = (a * a + b * b for a, b in pairs)
        any_phase = any(a < 0.0 or b for a, b in pairs)
        return Read(table=shares_everywhere(r_s, r_p, t_s, t_p), notes=phases * any_phase)
    if block.kind == "TABLE":
        rows, any_phase = _table(block, place)
        beyond = _beyond(f"the coating {name}", rows, waves)
        return Read(table=_held(rows), notes=[*phases * any_phase, *beyond])
    layers, notes = [], []
    for at, words in _repeated(block, place):
        here = f"{place}, line {at}"
        if words[0].upper() not in file.materials:
            raise InputError(f"{here}: there is no material {words[0]} (MATE)")
        what = f"material {words[0]}"
        mate = _only(file.materials[words[0].upper()], f"{file.path}: {what}")
        rows = _material(mate, f"{file.path}: {what}")
        notes += _beyond(f"the {what}", rows, waves)
        _numbers(words[1:], 1, here)
        if len(words) > 2 and number_in_text(words[2], here):
            thickness = scaled(words[1], _NM, here)
        else:
            thickness = float(words[1]) * waves[0] / _index_in(rows, waves[0])
        rows = _ends(rows)
        layers.append({"material": rows if rows[1:] else rows[0][1:], "thickness": thickness})
    return Read(layers, notes=notes)


def _only(blocks: list[Block], place: str) -> Block:
    """Return the one block of a name; `InputError` where others of it say something else."""
    first = blocks[0]
    for other in blocks[1:]:
        same = [words for _, words in other.lines] == [words for _, words in first.lines]
        if not same or (other.kind, other.words[1:]) != (first.kind, first.words[1:]):
            raise InputError(f"{place} is there twice, in lines {first.at} and {other.at}")
    return first


def _numbers(words: list[str], count: int, place: str) -> list[float]:
    if len(words) < count:
        raise InputError(f"{place}: needs {count} numbers, not {len(words)}")
    return [number_in_text(word, place) for word in words[:count]]


def _beyond(what: str, rows: list[list[float]], waves: Sequence[float]) -> list[str]:
    """Return a sentence where a lens has light beyond the wavelengths of rows that rise."""
    first, last = min(row[0] for row in rows), max(row[0] for row in rows)
    if first == last or (first <= min(waves) and max(waves) <= last):
        return []
    return [f"{what} beyond its {first:g} to {last:g} nm, where its ends hold"]


def _ends(rows: list[list[float]]) -> list[list[float]]:
    """Return rows whose first and last value hold at all shorter and longer wavelengths."""
    if len(rows) < 2:
        return rows
    first = [] if rows[0][0] <= SHORTEST else [[SHORTEST, *rows[0][1:]]]
    last = [] if rows[-1][0] >= LONGEST else [[LONGEST, *rows[-1][1:]]]
    return [*first, *rows, *last]


def _material(block: Block, place: str) -> list[list[float]]:
    """Return rows [nm, n, k] of a material, k positive where it absorbs."""
    rows = []
    for at, words in block.lines:
        here = f"{place}, line {at}"
        n, imaginary = _numbers([*words[1:], "0"], 2, here)
        if imaginary > 0.0:
            raise InputError(f"{here}: the imaginary part {imaginary:g} amplifies light")
        rows.append([scaled(words[0], _NM, here), n, -imaginary or 0.0])
    if not rows:
        raise InputError(f"{place}: has no index (line {block.at})")
    if any(a[0] >= b[0] for a, b in pairwise(rows)):
        raise InputError(f"{place}: its wavelengths must rise (line {block.at})")
    return rows


def _index_in(rows: list[list[float]], wavelength: float) -> float:
    """Return the real index at a wavelength (nm)."""
    for (low, n, _), (high, m, _) in pairwise(_ends(rows)):
        if low <= wavelength <= high:
            return n + (wavelength - low) / (high - low) * (m - n)
    return rows[0][1]


def _repeated(block: Block, place: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a stack's layers, groups as often as their loop number says.

    Raises:
        InputError: a layer has a taper, or groups are not closed, or one stands in another.
    """
    group: list[tuple[int, list[str]]] = []
    times = count = 0
    for at, words in block.lines:
        here = f"{place}, line {at}"
        if len(words) > 4 and words[4] != "0":
            raise InputError(f"{here}: a layer that tapers ({words[4]}) is not held")
        loop = number_in_text(words[3], here) if len(words) > 3 else 0.0
        if loop and (loop < 2 or loop != int(loop) or loop > _MOST_LAYERS):
            raise InputError(f"{here}: the loop number must be whole, 2 to {_MOST_LAYERS}")
        if loop and times and loop != times:
            raise InputError(f"{here}: the loop of {times} is not closed")
        group.append((at, words))
        if loop and not times:
            times = int(loop)
            continue
        if loop or not times:
            count += len(group) * (times or 1)
            if count > _MOST_LAYERS:
                raise InputError(f"{place}: has more than {_MOST_LAYERS} layers")
            yield from group * (times or 1)
            group, times = [], 0
    if times:
        raise InputError(f"{place}: the loop of {times} is not closed")


def _table(block: Block, place: str) -> tuple[list[list[float]], bool]:
    """Return the rows of a table [nm, degrees, R_s, R_p, T_s, T_p], and whether it has phases."""
    rows: list[list[float]] = []
    angle, phases = None, False
    for at, words in block.lines:
        here = f"{place}, line {at}"
        key = words[0].upper()
        if key == "ANGL":
            (angle,) = _numbers(words[1:], 1, here)
        elif key != "WAVE" or angle is None:
            raise InputError(f"{here}: expected ANGL and then WAVE, not {words[0]}")
        else:
            shares = _numbers(words[2:], 4, here)
            phases = phases or any(number_in_text(word, here) for word in words[6:10])
            rows.append([scaled(words[1], _NM, here), angle, *shares])
    if not rows:
        raise InputError(f"{place}: the table is empty (line {block.at})")
    first = min(row[1] for row in rows)
    if first > 0.0:
        rows = [*([row[0], 0.0, *row[2:]] for row in rows if row[1] == first), *rows]
    return rows, phases


def _held(rows: list[list[float]]) -> list[list[float]]:
    """Return the rows of a table with the first and last wavelength's held beyond them."""
    parts = groupby(rows, key=lambda row: row[1])
    return [row for _, part in parts for row in _ends(list(part))]
