"""The catalogues of a Zemax file (`GCAT`): which glass a name of the file means."""

import logging
import re
from collections.abc import Sequence
from decimal import Decimal

from dolens.errors import InputError
from dolens.optics.glass_catalog import (
    MAKERS,
    find_glass,
    glass_names,
    is_old_name,
    likely_makers,
    makers_of,
    suggestion,
)
from dolens.optics.glass_catalog import catalogues as known_catalogues
from dolens.optics.materials import Medium, abbe_number, index_d

# Zemax prints what its catalogue gives: half of what tells Schott's F2 from Hikari's.  Where a file
# prints fewer decimals, half a unit of the last.
_ND, _VD = 5e-5, 0.02
# Hikari's catalogue under the names of its owner, and another name of Schott's infrared glasses.
_OTHER_NAMES = {"NIKON": "HIKARI", "NIKON-HIKARI": "HIKARI", "SCHOTT_IRG": "SCHOTT_IG"}

# Glasses that Schott once had and that its table here lacks: nd and Vd of Robb and Mercado, Applied
# Optics 22 (1983) 1198, and of lens makers' lists.
_LOST = {
    "KZFS4": ("1.6134", "44.3"),
    "LASF9": ("1.85026", "32.2"),
    "SF56": ("1.7847", "26.1"),
    "SK19": ("1.61342", "57.4"),
    "SSK4": ("1.61765", "55.1"),
}
# What some programs call media that catalogues know by another name.
_SAME_MEDIUM = {
    "FUSEDSILICA": "MISC:F_SILICA",
    "FUSED_SILICA": "MISC:F_SILICA",
    "FUSED-SILICA": "MISC:F_SILICA",
}
# A name of letters and digits as long as this is a product's: nobody else gives it by chance.
_PRODUCT = re.compile(r"(?=.*[A-Z])(?=.*\d)[A-Z0-9_-]{5,}")

logger = logging.getLogger(__name__)

Pair = tuple[str, str]


def named_glass(name: str, catalogues: Sequence[str] | None, pair: Pair | None, place: str) -> str:
    """Return catalogue and name of the glass that a file means.

    Args:
        name: as in the file.
        catalogues: the words of GCAT; None where the file has none.
        pair: nd and Vd as the file prints them beside the name; None where it prints none.
        place: name of the surface in messages.

    Raises:
        InputError: no catalogue of the file has the name, or one that is not known here may mean
            another glass by it.
    """
    having = makers_of(name)
    if catalogues is None:
        return _without_catalogues(name, having, pair, place)
    doubtful: list[str] = []
    for catalogue in catalogues:
        known = known_catalogue(catalogue)
        if known in having:
            found = _of(known, name)
            # Schott's own glass of that name, where GCAT names Schott first, had this nd and Vd.
            lost = _LOST.get(name.upper()) if doubtful == ["SCHOTT"] else None
            meant = pair or lost
            if doubtful and not (meant and _agrees(found, meant)):
                raise InputError(
                    f"{place}: {' and '.join(doubtful)}, which GCAT names before {catalogue}, may "
                    f"have another glass of that name that is not known here; {_instead(pair)}"
                )
            return found
        if may_have(known, name):
            doubtful.append(catalogue)
    agreeing = [c for c in having if pair and _agrees(_of(c, name), pair)]
    unknown = [catalogue for catalogue in catalogues if known_catalogue(catalogue) is None]
    owner = agreeing[0] if agreeing else _owner(name) if pair is None else None
    if unknown and owner:
        return _of(owner, name)
    same = _SAME_MEDIUM.get(name.upper())
    if same and not having:
        logger.warning("%s is read as %s: no catalogue of the file has the name", place, same)
        return same
    elsewhere = f"; {' and '.join(having)} has another of that name" if having else ""
    if not having:
        elsewhere = _near(name, catalogues)
    raise InputError(
        f"{place} is in none of the file's catalogues as they are known here (GCAT "
        f"{' '.join(catalogues)}){elsewhere}; {_instead(pair)}"
    )


def _without_catalogues(name: str, having: Sequence[str], pair: Pair | None, place: str) -> str:
    for makers in (likely_makers(name), having):
        agreeing = [maker for maker in makers if pair and _agrees(_of(maker, name), pair)]
        if len(agreeing) == 1:
            return _of(agreeing[0], name)
    try:
        return find_glass(name).name
    except InputError as error:
        if not having:
            raise InputError(f"{place}: {error}; {_instead(pair)}") from None
        raise InputError(
            f"{place}: the file has no GCAT, and several makers gave that name "
            f"(here: {', '.join(having)}); add GCAT with the maker meant; {_instead(pair)}"
        ) from None


def known_catalogue(catalogue: str) -> str | None:
    """Return the catalogue here that a word of GCAT means; editions have a suffix."""
    word = catalogue.upper()
    names = known_catalogues()
    if word in names:
        return word
    if word in _OTHER_NAMES:
        return _OTHER_NAMES[word]
    editions = {**{maker: maker for maker in MAKERS}, "NIKON-HIKARI": "HIKARI"}
    return next((m for w, m in editions.items() if re.fullmatch(rf"{w}[-_\d].*", word)), None)


def may_have(known: str | None, name: str) -> bool:
    """Return whether a catalogue may have a glass of that name, which is not known here.

    Schott's table lacks what Schott had given up by 2006.  A catalogue that is not known may have
    anything but another maker's glass by that maker's own name: N-BK7 is Schott's everywhere.
    """
    if known is None:
        return _owner(name) is None
    return known == "SCHOTT" and is_old_name(name)


def may_have_another(known: str, name: str, glass: str) -> bool:
    """Return whether a catalogue may have a glass of that name that differs from the one of another
    catalogue.

    Schott's own SSK4 had the nd and Vd of Sumita's: there either will do.
    """
    lost = _LOST.get(name.upper()) if known == "SCHOTT" else None
    return may_have(known, name) and not (lost and _agrees(glass, lost))


def _owner(name: str) -> str | None:
    """Return the only catalogue that gives a name, if it is a maker's own or a product's."""
    having = [catalogue for catalogue in makers_of(name) if catalogue != "PLASTIC"]
    makers = [catalogue for catalogue in having if catalogue in MAKERS]
    if is_old_name(name):
        return None
    if len(makers) == 1:
        return makers[0]
    return having[0] if len(having) == 1 and _PRODUCT.fullmatch(name.upper()) else None


def _near(name: str, catalogues: Sequence[str]) -> str:
    """Return `; did you mean ...` of glasses in the file's known catalogues, or nothing."""
    known = [found for catalogue in catalogues if (found := known_catalogue(catalogue))]
    return suggestion(name, [glass for catalogue in known for glass in glass_names(catalogue)])


def _agrees(found: str, pair: Pair) -> bool | None:
    """Return whether a glass has that nd and Vd; None where it has none, for example in the
    infrared.
    """
    own = index_and_abbe_number(find_glass(found))
    if own is None:
        return None
    printed = zip(own, pair, (_ND, _VD), strict=True)
    return all(abs(x - float(text)) <= max(least, _half_unit(text)) for x, text, least in printed)


def _half_unit(text: str) -> float:
    """Return half a unit of the last decimal that is written."""
    return 0.5 * 10.0 ** int(Decimal(text).as_tuple().exponent)


def index_and_abbe_number(medium: Medium) -> tuple[float, float] | None:
    """Return nd and Vd; None of a medium whose range ends short of the lines F, d and C."""
    try:
        return index_d(medium), abbe_number(medium)
    except InputError:
        return None


def _of(catalogue: str, name: str) -> str:
    return find_glass(f"{catalogue}:{name}").name


def _instead(pair: Pair | None) -> str:
    nd, vd = pair or ("nd", "Vd")
    return f"for a glass by its nd and Vd write GLAS ___BLANK 1 0 {nd} {vd}"
