"""Catalogue glasses by name: of the makers' tables that come with dolens, and of the user's own."""

import csv
import difflib
import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.files import decode_text, read_file
from dolens.optics import dispersion
from dolens.optics.agf import AgfEntry, parse_agf, read_entry
from dolens.optics.glass import Environment, Glass, ThermalCoefficients

__all__ = [
    "Glass",
    "catalogues",
    "find_glass",
    "glass_names",
    "is_old_name",
    "likely_makers",
    "makers_of",
    "suggestion",
]

_PLASTIC = "PLASTIC"
# Other names of plastics, where no catalogue is named.
_ALIASES = {
    "ACRYLIC": "PMMA",
    "PC": "POLYCARBONATE",
    "POLYCARB": "POLYCARBONATE",
    "PS": "POLYSTYRENE",
    "POLYSTYR": "POLYSTYRENE",
    "E48R": "ZEONEX-E48R",
}
# Names of Schott's old scheme (F2, BAF8, LASFN9).  Others made glasses of their own by these names.
_OLD_NAME = re.compile(
    r"(BAFN?|BAK|BALF|BALKN?|BASF|BK|F|FK|FN|K|KF|KZFN|KZFSN?|LAFN?|LAK[LN]?|LASFN?|LF|LLF|PK|PSK"
    r"|SF[LN]?|SK|SSKN?|TIFN?|UBK|UK|ZKN?)[1-9]\d*[A-Z]*"
)


def find_glass(text: str, air: float = 1.0, environment: Environment | None = None) -> Glass:
    """Return the catalogue glass of that name, in any case.

    Args:
        text: a name, for example `N-BK7`, or catalogue and name, for example `schott:n-bk7`.
            `catalogues` lists the catalogues.
        air: index of air in the index model at hand.
        environment: temperature and pressure; None: those that the catalogue's index holds for.

    Raises:
        InputError: no glass has that name (the message names near ones), or several makers have
            one (the message names them: their glasses differ), or its numbers cannot be read.
            A name of Schott's old scheme that only another maker has here, for example `ZK5`,
            needs its maker: Schott's own may have been another glass.
    """
    maker, colon, name = (_key(part) for part in text.rpartition(":"))
    own = user_catalogues()
    known = catalogues()
    if colon and maker not in known:
        raise InputError(
            f"unknown material '{text}': no maker '{maker}'{suggestion(maker, known)} "
            f"(allowed: {', '.join(known)})"
        )
    if maker in ("", _PLASTIC):
        name = _ALIASES.get(name, name)
    having = [catalogue for catalogue in known if _has(catalogue, name, own)]
    makers = [maker] if maker in having else [] if maker else _meant(name, having)
    if not makers:
        elsewhere = f"; it is a glass of {' and '.join(having)}" if having else ""
        near = suggestion(name, _names(maker)) or ("" if maker else suggestion(name, _further()))
        hint = elsewhere + near
        raise InputError(
            f"unknown material '{text}'{hint} (allowed: air, occluder, a number from 0.1 to 10, "
            "glass as nd/Vd or nd/Vd/ΔPgF, for example 1.5168/64.17, or by its catalogue name, "
            "for example N-BK7 or SCHOTT:N-BK7)"
        )
    found = [_read(catalogue, name, own) for catalogue in makers]
    choice = " or ".join(glass.name for glass in found)
    if len({(glass.formula, glass.constant, glass.terms) for glass in found}) > 1:
        raise InputError(
            f"material '{text}' is in the catalogues of {', '.join(makers)}; write {choice}"
        )
    if not maker and makers[0] in MAKERS and makers[0] != "SCHOTT" and is_old_name(name):
        raise InputError(
            f"material '{text}' is a name that SCHOTT gave too, to a glass that the catalogue here "
            f"lacks; write {choice}, or nd/Vd of the glass meant"
        )
    return replace(found[0], air=air, environment=environment)


def catalogues() -> tuple[str, ...]:
    """Return the names of the catalogues: the makers, the user's own, and the further tables.

    Raises:
        InputError: a folder of the user's is not there.
    """
    own = [name for name in user_catalogues() if name not in MAKERS + FURTHER]
    return (*MAKERS, *own, *FURTHER)


def makers_of(name: str) -> tuple[str, ...]:
    """Return the catalogues that have a glass of that name here, in any case; none where no
    catalogue has.
    """
    key = _key(name)
    own = user_catalogues()
    found = tuple(catalogue for catalogue in catalogues() if _has(catalogue, key, own))
    alias = _ALIASES.get(key)
    return (_PLASTIC, *found) if alias and _PLASTIC not in found else found


def likely_makers(name: str) -> tuple[str, ...]:
    """Return the catalogues that a name without one most likely means (see the module's text)."""
    return tuple(_meant(_key(name), list(makers_of(name))))


def is_old_name(name: str) -> bool:
    """Tell whether a name is of Schott's old scheme, which several makers used, such as `F6`."""
    return _OLD_NAME.fullmatch(_key(name)) is not None


def suggestion(word: str, allowed: Iterable[str]) -> str:
    """`; did you mean 'a', 'b' or 'c'?` of up to three near words, or nothing; case is ignored."""
    by_key = {name.lower(): name for name in allowed}
    near = [f"'{by_key[key]}'" for key in difflib.get_close_matches(word.lower(), by_key, n=3)]
    if not near:
        return ""
    *others, final = near
    return f"; did you mean {', '.join(others)}{' or ' if others else ''}{final}?"


def _key(text: str) -> str:
    """Return a name in capitals; Ohara and Sumita print blanks within some, the tables do not."""
    return "".join(text.upper().split())


def _has(catalogue: str, key: str, own: Mapping[str, Path]) -> bool:
    if catalogue in own and key in user_entries(own[catalogue]):
        return True
    return catalogue in MAKERS + FURTHER and key in table(catalogue)


def _read(catalogue: str, key: str, own: Mapping[str, Path]) -> Glass:
    """Return a glass; a user's file named as a maker is asked before the maker's table."""
    entries = user_entries(own[catalogue]) if catalogue in own else {}
    return user_glass(catalogue, entries[key]) if key in entries else table_glass(catalogue, key)


def _meant(key: str, having: list[str]) -> list[str]:
    """Return the catalogues that a name without one may mean.

    Makers come first, and among them those whose main edition or, of Schott, any edition has the
    name; then the user's own catalogues, and the further ones last.
    """
    makers = [catalogue for catalogue in having if catalogue in MAKERS]
    main = [maker for maker in makers if key in table(maker) and is_main(maker, key)]
    others = [catalogue for catalogue in having if catalogue not in MAKERS + FURTHER]
    return main or makers or others or having


def glass_names(catalogue: str) -> list[str]:
    """Return the names of all glasses of a catalogue, as it writes them."""
    own = user_catalogues()
    names = []
    if catalogue in MAKERS + FURTHER:
        names += [row["name"] for row in table(catalogue).values()]
    if catalogue in own:
        names += [entry.name for entry in user_entries(own[catalogue]).values()]
    return names


def _names(maker: str) -> list[str]:
    """Return what a misspelt name may have meant first: a glass of that maker, or of any."""
    media = [] if maker else ["air", "occluder", "mirror"]
    chosen = [maker] if maker else MAKERS
    return media + [name for catalogue in chosen for name in glass_names(catalogue)]


def _further() -> list[str]:
    """Return the names of all other catalogues."""
    others = [catalogue for catalogue in catalogues() if catalogue not in MAKERS]
    return [name for catalogue in others for name in glass_names(catalogue)]


# The makers whose names mean their glasses without saying so, in the order of messages; and the
# others, whose glasses a bare name means where none of those has it.
MAKERS = ("SCHOTT", "OHARA", "HOYA", "CDGM", "SUMITA", "HIKARI", "PLASTIC")
FURTHER = (
    *("MISC", "INFRARED", "SCHOTT_IG", "CORNING", "HERAEUS", "LZOS", "EYE", "BIREFRINGENT"),
    *("LIGHTPATH", "RPO", "NHG", "PILKINGTON", "ARCHER", "TOPAS", "ZEON", "UMICORE"),
    *("ISUZU", "RAD_HARD"),
)
_FORMULAS = {
    formula.__name__: formula
    for formula in (
        dispersion.sellmeier,
        dispersion.sellmeier_squared,
        dispersion.sellmeier_with_offset,
        dispersion.sellmeier_with_pole,
        dispersion.pole_and_powers,
        dispersion.resonance_and_powers,
        dispersion.polynomial,
        dispersion.cauchy,
        dispersion.herzberger,
    )
}
# The source of the names that mean a maker's glass wherever no other maker here has them: the
# catalogues of 2013 to 2022 in refractiveindex.info's database.
_MAIN_SOURCE = "rii"


def is_main(maker: str, key: str) -> bool:
    """Tell whether a bare name may mean a maker's glass before those of other editions.

    Schott's old glasses are among them: files name them without saying whose they are.
    """
    return maker == "SCHOTT" or table(maker)[key]["source"] == _MAIN_SOURCE


@cache
def table(maker: str) -> dict[str, dict[str, str]]:
    """Return name in capitals → row of a maker's table.

    Raises:
        InputError: no table is of that maker.
    """
    if maker not in MAKERS + FURTHER:
        raise InputError(f"no maker '{maker}' (allowed: {', '.join(MAKERS + FURTHER)})")
    file = resources.files("dolens.optics").joinpath("glass_data", f"{maker.lower()}.csv")
    rows = csv.DictReader(io.StringIO(file.read_text(encoding="ascii"), newline=""))
    return {row["name"].upper(): row for row in rows}


def table_glass(maker: str, key: str) -> Glass:
    """Return the glass of a maker's table under that name in capitals, in its own environment."""
    row: dict[str, Any] = table(maker)[key]
    first, last = (round(dispersion.NM_PER_UM * float(word), 6) for word in row["range_um"].split())
    thermal = [float(word) for word in row["thermal"].split()]
    return Glass(
        f"{maker}:{row['name']}",
        _FORMULAS[row["formula"]],
        float(row["constant"]),
        _pairs(row["terms"]),
        (first, last),
        thermal=ThermalCoefficients(*thermal) if thermal else None,
        expansion=1e-6 * float(row["expansion"]) if row["expansion"] else None,
    )


def _pairs(text: str) -> tuple[tuple[float, float], ...]:
    values = [float(word) for word in text.split()]
    return tuple(zip(values[::2], values[1::2], strict=True))


VARIABLE = "DOLENS_GLASS"
# The largest catalogue of a maker has 2 MB.
_LARGEST = 32 * 2**20
# Set for as long as a lens is read or written, by `glass_folders`.
_asked: ContextVar[tuple[Path, ...]] = ContextVar("glass folders", default=())


@contextmanager
def glass_folders(places: Sequence[str | Path] | str | Path | None) -> Iterator[None]:
    """Look for glasses in these folders or `.agf` files, too, within a `with` statement.

    Raises:
        InputError: one of them does not exist.
    """
    given = [places] if isinstance(places, str | Path) else list(places or ())
    paths = tuple(Path(place) for place in given)
    for path in paths:
        if not os.path.exists(path):
            raise InputError(f"glass catalogues: '{path}' is no folder and no file")
    token = _asked.set((*paths, *_asked.get()))
    try:
        yield
    finally:
        _asked.reset(token)


def user_catalogues() -> dict[str, Path]:
    """Return catalogue → file; the first folder that has a catalogue's name gives it.

    Raises:
        InputError: a place that `DOLENS_GLASS` names does not exist.
    """
    found: dict[str, Path] = {}
    for place in _places():
        if os.path.isdir(place):
            files = sorted(p for p in _listed(place) if p.suffix.lower() == ".agf")
        elif os.path.exists(place):
            files = [place]
        else:
            raise InputError(f"{VARIABLE}: '{place}' is no folder and no file")
        for file in files:
            found.setdefault("".join(file.stem.upper().split()), file)
    return found


def user_file(name: str) -> Path | None:
    """Return the file of a name, in any case, in the first folder of the user's that has one."""
    folders = (place for place in _places() if os.path.isdir(place))
    files = (file for folder in folders for file in sorted(_listed(folder)))
    return next((file for file in files if file.name.upper() == name.upper()), None)


def _places() -> tuple[Path, ...]:
    """Return the user's folders and files, those that are asked for first."""
    named = os.environ.get(VARIABLE, "").split(os.pathsep)
    return (*_asked.get(), *(Path(place) for place in named if place))


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror})") from None


def user_entries(file: Path) -> dict[str, AgfEntry]:
    """Return name in capitals → entry of a user's catalogue.

    Raises:
        InputError: the file cannot be read, or is no catalogue.
    """
    try:
        state = file.stat()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    return _entries(file, state.st_mtime_ns, state.st_size)


def user_glass(catalogue: str, entry: AgfEntry) -> Glass:
    """Return a glass of a user's catalogue, in its own environment.

    Raises:
        InputError: its numbers cannot be read (see `dolens.optics.agf.read_entry`).
    """
    glass = read_entry(entry)
    first, last = (round(dispersion.NM_PER_UM * end, 6) for end in glass.wavelengths)
    return Glass(
        f"{catalogue}:{glass.name}",
        *glass.dispersion,
        (first, last),
        thermal=glass.thermal,
        expansion=glass.expansion,
        absorptions=glass.absorptions,
    )


# The time and size of the file are part of the key: an edited catalogue is read again.
@lru_cache(maxsize=64)
def _entries(file: Path, changed: int, size: int) -> dict[str, AgfEntry]:
    data = read_file(file, _LARGEST, "glass catalogue")
    return parse_agf(decode_text(data, str(file)), str(file))
