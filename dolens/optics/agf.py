"""Glass catalogues in Zemax's text format (`.agf`) and their thirteen dispersion formulas.

A catalogue lists glasses one after another.  Each begins with the line NM and goes on with others,
a keyword of two letters and its numbers:

    NM  name, number of the dispersion formula, glass code, nd, Vd, exclusion, status, ...
    GC  comment
    ED  expansion from -30 to 70 °C and from 100 to 300 °C (1e-6/K), density, ΔPgF, ...
    CD  coefficients of the dispersion formula (µm), some programs wrap them over several lines
    TD  D0, D1, D2, E0, E1, λtk, reference temperature (°C): see `dolens.optics.glass`
    OD  price relative to N-BK7, then CR, FR, SR, AR, PR: resistance to climate, stain, acid, alkali
        and phosphate in the makers' classes (1, of FR 0, is the best)
    LD  the first and the last wavelength (µm) that the coefficients hold for
    IT  wavelength (µm), internal transmittance, thickness (mm)

A file is only data: nothing in it is run, and what is wrong in one glass refuses that glass alone.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dolens.errors import InputError, comma_hint
from dolens.optics.dispersion import (
    Formula,
    Terms,
    cauchy,
    herzberger,
    pole_and_powers,
    polynomial,
    resonance_and_powers,
    sellmeier_squared,
    sellmeier_with_offset,
    sellmeier_with_pole,
)
from dolens.optics.glass import ThermalCoefficients


class Dispersion(NamedTuple):
    """A dispersion formula and its coefficients, see `dolens.optics.dispersion`."""

    formula: Formula
    constant: float
    terms: Terms


def agf_dispersion(number: int, coefficients: Sequence[float]) -> Dispersion:
    """Return the formula of that number with the coefficients of a catalogue's line CD.

    Args:
        number: 1 Schott, 2 Sellmeier 1, 3 Herzberger, 4 Sellmeier 2, 5 Conrady, 6 Sellmeier 3,
            7 and 8 Handbook of Optics 1 and 2, 9 Sellmeier 4, 10 Extended, 11 Sellmeier 5,
            12 Extended 2, 13 Extended 3.
        coefficients: in the catalogue's order, for µm; those left out are 0.

    Raises:
        InputError: there is no such formula, or one with fewer coefficients.
    """
    if number not in _FORMULAS:
        raise InputError(f"dispersion formula {number} is unknown (allowed: 1 to 13)")
    count, make = _FORMULAS[number]
    if any(coefficients[count:]):
        raise InputError(
            f"dispersion formula {number} has {count} coefficients, and more are given"
        )
    padded = [float(value) for value in coefficients[:count]]
    return make(padded + [0.0] * (count - len(padded)))


def _pairs(values: Sequence[float]) -> Terms:
    """Return strengths and resonances, without those of no strength."""
    pairs = zip(values[::2], values[1::2], strict=True)
    return tuple((b, c) for b, c in pairs if b != 0.0)


def _powers(values: Sequence[float], exponents: Sequence[float]) -> Terms:
    return tuple((a, e) for a, e in zip(values, exponents, strict=True) if a != 0.0)


def _sellmeier(values: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_squared, 0.0, _pairs(values))


def _series(*exponents: float) -> tuple[int, Callable[[Sequence[float]], Dispersion]]:
    def make(values: Sequence[float]) -> Dispersion:
        return Dispersion(polynomial, values[0], _powers(values[1:], exponents))

    return len(exponents) + 1, make


def _herzberger(v: Sequence[float]) -> Dispersion:
    return Dispersion(herzberger, v[0], tuple(zip(v[1:], (1.0, 2.0, 2.0, 4.0, 6.0), strict=True)))


def _sellmeier_2(v: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_with_pole, v[0], ((v[1], v[2]), (v[3], v[4])))


def _conrady(v: Sequence[float]) -> Dispersion:
    return Dispersion(cauchy, v[0], _powers(v[1:], (-1.0, -3.5)))


def _handbook(formula: Formula) -> Callable[[Sequence[float]], Dispersion]:
    def make(v: Sequence[float]) -> Dispersion:
        return Dispersion(formula, v[0], ((v[1], v[2]), (-v[3], 2.0)))

    return make


def _sellmeier_4(v: Sequence[float]) -> Dispersion:
    return Dispersion(sellmeier_with_offset, v[0], _pairs(v[1:]))


# Number → how many coefficients it has, and what they mean.
_FORMULAS: dict[int, tuple[int, Callable[[Sequence[float]], Dispersion]]] = {
    1: _series(2.0, -2.0, -4.0, -6.0, -8.0),
    2: (6, _sellmeier),
    3: (6, _herzberger),
    4: (5, _sellmeier_2),
    5: (3, _conrady),
    6: (8, _sellmeier),
    7: (4, _handbook(pole_and_powers)),
    8: (4, _handbook(resonance_and_powers)),
    9: (5, _sellmeier_4),
    10: _series(2.0, -2.0, -4.0, -6.0, -8.0, -10.0, -12.0),
    11: (10, _sellmeier),
    12: _series(2.0, -2.0, -4.0, -6.0, -8.0, 4.0, 6.0),
    13: _series(2.0, 4.0, -2.0, -4.0, -6.0, -8.0, -10.0, -12.0),
}


_LINE_END = re.compile(r"\r\n|\r|\n")
_KEYWORD = re.compile(r"[A-Z]{2}")
# Written where a catalogue has no value.
_MISSING = ("-", "_", "--")
# Resistance to climate, stain, acid, alkali and phosphate, in the order of line OD.
RESISTANCES = ("CR", "FR", "SR", "AR", "PR")
_STATUS = {
    0: "standard",
    1: "preferred",
    2: "obsolete",
    3: "special",
    4: "melt",
    5: "inquiry",
    6: "experimental",
}

# Internal transmittances are printed to three or four digits.
_LEAST_SHARE = 1e-4

STATUSES = tuple(_STATUS.values())


@dataclass(frozen=True)
class AgfGlass:
    """A glass as a catalogue file gives it.

    Attributes:
        name: as written.
        dispersion: formula and coefficients.
        wavelengths: µm, the first and the last that the coefficients hold for.
        nd: the index at the d line as the catalogue prints it; NaN where it prints none.
        vd: its Abbe number likewise.
        thermal: how the index depends on temperature; None where nothing is printed.
        expansion: 1/K, linear, from -30 to 70 °C; None where nothing is printed.
        transmittance: (wavelength in µm, internal transmittance, thickness in mm) in their order.
        status: `standard`, `preferred`, `obsolete`, `special`, `melt`, `inquiry`, `experimental`,
            or nothing.
        density: g/cm³; None where nothing is printed.
        price: relative to the maker's N-BK7 or its like; None where nothing is printed.
        resistances: (one of `RESISTANCES`, class) of those that are printed; a low class is good.
    """

    name: str
    dispersion: Dispersion
    wavelengths: tuple[float, float]
    nd: float
    vd: float
    thermal: ThermalCoefficients | None
    expansion: float | None
    transmittance: tuple[tuple[float, float, float], ...]
    status: str
    density: float | None
    price: float | None
    resistances: tuple[tuple[str, float], ...]

    @property
    def absorptions(self) -> tuple[tuple[float, float], ...]:
        """Return rows of wavelength (nm) and absorption (1/mm), by Beer's law τ = exp(-a·d).

        A share that is printed as zero is less than the last digit that catalogues print: it counts
        as 1e-4.  Of several rows at one wavelength the thickest counts: it is known best.
        """
        found: dict[float, tuple[float, float]] = {}
        for at, share, path in self.transmittance:
            nm = round(1000.0 * at, 6)
            if path > found.get(nm, (0.0, 0.0))[0]:
                found[nm] = path, -math.log(max(share, _LEAST_SHARE)) / path
        return tuple((nm, found[nm][1]) for nm in sorted(found))


@dataclass
class AgfEntry:
    """The lines of one glass, which `read_entry` reads when the glass is asked for.

    Attributes:
        name: as written.
        place: name of the file and line in messages.
        lines: keyword → the words of its lines.
    """

    name: str
    place: str
    lines: dict[str, list[list[str]]] = field(default_factory=dict)


def parse_agf(text: str, where: str) -> dict[str, AgfEntry]:
    """Sort the lines of a catalogue by glass; of two glasses of one name the first is kept.

    Args:
        text: the file's content, decoded (see `dolens.files`).
        where: name of the file in messages.

    Returns:
        Name in capitals without blanks → its entry.

    Raises:
        InputError: the file holds no glass.
    """
    entries: dict[str, AgfEntry] = {}
    entry: AgfEntry | None = None
    last = ""
    for at, raw in enumerate(_LINE_END.split(text), 1):
        words = raw.split()
        if not words:
            continue
        keyword = words[0].upper()
        if keyword == "NM" and len(words) > 1:
            entry = AgfEntry(words[1], f"{where}: line {at}: glass '{words[1]}'")
            entries.setdefault(words[1].upper(), entry)
        if entry is None:
            continue
        if _KEYWORD.fullmatch(keyword):
            entry.lines.setdefault(keyword, []).append(words[1:])
            last = keyword
        elif last == "CD":
            entry.lines[last][-1].extend(words)
    if not entries:
        raise InputError(f"{where}: holds no glass (a catalogue lists them in lines NM)")
    return entries


def read_entry(entry: AgfEntry) -> AgfGlass:
    """Read the numbers of one glass.

    Raises:
        InputError: its formula, coefficients or range of wavelengths are missing or no numbers;
            the message is one line that names the file, the line and the glass.
    """
    place = entry.place
    head = _numbers(entry, "NM", slice(1, None), optional=True)
    number = head[0] if head else math.nan
    if not number.is_integer():
        raise InputError(f"{place}: line NM must give the number of its dispersion formula")
    coefficients = _numbers(entry, "CD")
    if not coefficients:
        raise InputError(f"{place}: line CD with its coefficients is missing")
    try:
        dispersion = agf_dispersion(int(number), coefficients)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    limits = _numbers(entry, "LD")
    if len(limits) < 2 or not 0.0 < limits[0] < limits[1]:
        raise InputError(f"{place}: line LD must give the shortest and the longest wavelength, µm")
    expansions = _numbers(entry, "ED", optional=True)
    expansion = expansions[0] if expansions and math.isfinite(expansions[0]) else None
    nd, vd = (head[at] if len(head) > at else math.nan for at in (2, 3))
    status = head[5] if len(head) > 5 else math.nan
    return AgfGlass(
        entry.name,
        dispersion,
        (limits[0], limits[1]),
        nd,
        vd,
        _thermal(entry),
        None if expansion is None else 1e-6 * expansion,
        _transmittance(entry),
        _STATUS.get(int(status), "") if math.isfinite(status) else "",
        expansions[2] if len(expansions) > 2 and expansions[2] > 0.0 else None,
        *_price_and_resistances(entry),
    )


def _thermal(entry: AgfEntry) -> ThermalCoefficients | None:
    values = _numbers(entry, "TD", optional=True)
    if len(values) < 7 or not any(values[:5]) or not all(map(math.isfinite, values[:7])):
        return None
    return ThermalCoefficients(*values[:7])


def _price_and_resistances(
    entry: AgfEntry,
) -> tuple[float | None, tuple[tuple[str, float], ...]]:
    """Return what line OD gives; -1 and - stand for nothing."""
    values = _numbers(entry, "OD", optional=True)
    if len(values) == len(RESISTANCES):
        # Schott leaves the price of some glasses blank.
        values = [math.nan, *values]
    price, *classes = values or [math.nan]
    pairs = zip(RESISTANCES, classes, strict=False)
    return price if price > 0.0 else None, tuple((name, v) for name, v in pairs if v >= 0.0)


def _transmittance(entry: AgfEntry) -> tuple[tuple[float, float, float], ...]:
    rows = []
    for words in entry.lines.get("IT", []):
        values = [_number(word, entry, "IT", True) for word in words[:3]]
        complete = len(values) == 3 and all(map(math.isfinite, values))
        if complete and values[0] > 0.0 and 0.0 <= values[1] <= 1.0 and values[2] > 0.0:
            rows.append((values[0], values[1], values[2]))
    return tuple(rows)


def _numbers(
    entry: AgfEntry, keyword: str, part: slice = slice(None), optional: bool = False
) -> list[float]:
    """Return the numbers of a line, NaN where an optional one has none."""
    words: Sequence[str] = entry.lines.get(keyword, [[]])[-1]
    return [_number(word, entry, keyword, optional) for word in words[part]]


def _number(word: str, entry: AgfEntry, keyword: str, optional: bool) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if math.isfinite(value) and "_" not in word:
        return value
    comma = comma_hint(word)
    if not comma and (optional or word in _MISSING):
        return math.nan if optional else 0.0
    raise InputError(f"{entry.place}: line {keyword}: '{word}' must be a finite number{comma}")
