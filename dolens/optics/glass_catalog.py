"""Catalogue glasses by name: of the makers' tables that come with dolens, and of the user's own.

A name is written with its catalogue, `SCHOTT:N-BK7`, or alone where it says enough.  Alone, it is
looked for among the makers and the plastics, then in the user's catalogues, then in the further
tables (`MISC`, `INFRARED`, ...), and must mean one medium where it is found.  Names that only
further editions of a maker's catalogue have, other than Schott's, come after the main ones.
"""

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from dolens.errors import InputError
from dolens.optics.glass import Glass
from dolens.optics.glass_folders import user_catalogues, user_entries, user_glass
from dolens.optics.glass_tables import FURTHER, MAKERS, is_main, table, table_glass
from dolens.optics.thermal import Environment

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
