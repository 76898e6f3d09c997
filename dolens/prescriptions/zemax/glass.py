"""The glass of a Zemax surface is a model (nd, Vd, ΔPgF), a code, or a name in a catalogue.

`GCAT` lists the catalogues that a file uses, and Zemax takes a name from the first that has it.
`GLAS name 0 0 nd Vd` repeats nd and Vd, which Zemax fills in, leaves at 1.5 and 40, or leaves as
they were for an earlier glass.  So the name decides here, too; where nd and Vd say something quite
different, the log says so in one line.

A catalogue here is one of `dolens.optics.glass_catalog.catalogues`: SCHOTT_2000 and CDGM-ZEMAX are
editions of the makers' own.  Where a catalogue that is not known here stands before the one that
has the name, and may have it too, nd and Vd must agree with the glass found: Schott once had
glasses that its table here lacks.  A file without GCAT gives a name that one maker alone uses, or
the only glass of that name whose nd and Vd agree.
"""

import logging
import re
from collections.abc import Sequence
from decimal import Decimal

from dolens.errors import InputError
from dolens.optics.crystals import Uniaxial
from dolens.optics.dispersion import deviation_of_two_terms
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
from dolens.optics.materials import (
    LARGEST_DEVIATION,
    MIRROR,
    Medium,
    abbe_number,
    index_d,
    index_model,
    parse_material,
)
from dolens.prescriptions.numbers import number_in_text
from dolens.prescriptions.other_programs import catalogue_order
from dolens.prescriptions.row_data import canonical

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
# By how much nd or Vd of a line must miss the glass that it names to be worth a line in the log.
_FAR_ND, _FAR_VD = 1e-3, 0.5
# Zemax leaves nd at 1.5, other programs at 0 or 1, where a name says it all.
_NOT_GIVEN = (0.0, 1.0, 1.5)
_MODEL, _PICKUP, _OFFSET = "1", "2", "4"
_BLANK = "___BLANK"
# Catalogue, series and name, as one supplier of lenses writes them: SCHOTT-BK|N-BK7.
_QUALIFIED = re.compile(r"([A-Za-z]+)(?:-\w+)?\|(.+)")
# nd - 1 and Vd in three digits each.
_CODE = re.compile(r"(\d{3})(\d{2})(\d)")
_PAIR = re.compile(r"([\d.]+)\s*/\s*([\d.]+)(?:\s*/\s*(\S+))?")
# ΔPgF that was written for a glass given by nd and Vd alone; what a file may round it to.
_SAME_DEVIATION = 1e-9


def _named_glass(name: str, catalogues: Sequence[str] | None, pair: Pair | None, place: str) -> str:
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
        known = _known_catalogue(catalogue)
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
        if _may_have(known, name):
            doubtful.append(catalogue)
    agreeing = [c for c in having if pair and _agrees(_of(c, name), pair)]
    unknown = [catalogue for catalogue in catalogues if _known_catalogue(catalogue) is None]
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


def _known_catalogue(catalogue: str) -> str | None:
    """Return the catalogue here that a word of GCAT means; editions have a suffix."""
    word = catalogue.upper()
    names = known_catalogues()
    if word in names:
        return word
    if word in _OTHER_NAMES:
        return _OTHER_NAMES[word]
    editions = {**{maker: maker for maker in MAKERS}, "NIKON-HIKARI": "HIKARI"}
    return next((m for w, m in editions.items() if re.fullmatch(rf"{w}[-_\d].*", word)), None)


def _may_have(known: str | None, name: str) -> bool:
    """Return whether a catalogue may have a glass of that name, which is not known here.

    Schott's table lacks what Schott had given up by 2006.  A catalogue that is not known may have
    anything but another maker's glass by that maker's own name: N-BK7 is Schott's everywhere.
    """
    if known is None:
        return _owner(name) is None
    return known == "SCHOTT" and is_old_name(name)


def _may_have_another(known: str, name: str, glass: str) -> bool:
    """Return whether a catalogue may have a glass of that name that differs from the one of another
    catalogue.

    Schott's own SSK4 had the nd and Vd of Sumita's: there either will do.
    """
    lost = _LOST.get(name.upper()) if known == "SCHOTT" else None
    return _may_have(known, name) and not (lost and _agrees(glass, lost))


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
    known = [found for catalogue in catalogues if (found := _known_catalogue(catalogue))]
    return suggestion(name, [glass for catalogue in known for glass in glass_names(catalogue)])


def _agrees(found: str, pair: Pair) -> bool | None:
    """Return whether a glass has that nd and Vd; None where it has none, for example in the
    infrared.
    """
    own = _index_and_abbe_number(find_glass(found))
    if own is None:
        return None
    printed = zip(own, pair, (_ND, _VD), strict=True)
    return all(abs(x - float(text)) <= max(least, _half_unit(text)) for x, text, least in printed)


def _half_unit(text: str) -> float:
    """Return half a unit of the last decimal that is written."""
    return 0.5 * 10.0 ** int(Decimal(text).as_tuple().exponent)


def _index_and_abbe_number(medium: Medium) -> tuple[float, float] | None:
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


def read_glass(
    words: Sequence[str],
    catalogues: Sequence[str] | None,
    place: str,
    surfaces: Sequence[Sequence[str]] = (),
) -> str:
    """Return the medium that the arguments of GLAS name, as a prescription writes it.

    Args:
        words: name, kind of solve (1 is a model, 2 a pick-up), surface of the pick-up, nd, Vd,
            ΔPgF, ...; none is air.
        catalogues: the arguments of GCAT; None where the file has none.
        place: name of the surface in messages.
        surfaces: the arguments of GLAS of all surfaces from 0, for pick-ups.

    Returns:
        `air`, `mirror`, nd/Vd/ΔPgF, nd/Vd, a constant index (a model whose Vd is 0), or catalogue
        and name.

    Raises:
        InputError: half a model, or a name that cannot be read as the file means it.
    """
    words = _picked_up(words, place, surfaces)
    if not words or words[0].upper() == "AIR":
        return "air"
    name, how = words[0], words[1] if len(words) > 1 else "0"
    if name.upper() == "MIRROR":
        return MIRROR.name
    place = f"{place}: GLAS {name}"
    if name == _BLANK or how == _MODEL:
        return _model(words, place)
    if how == _OFFSET and any(number_in_text(w, place) for w in words[9:11]):
        raise InputError(f"{place} with offsets of nd or Vd is not held")
    pair = _printed(words, place)
    code = _CODE.fullmatch(name)
    if code and not makers_of(name):
        return _with_vd(f"1.{code[1]}", f"{int(code[2])}.{code[3]}", "0")
    qualified = _QUALIFIED.fullmatch(name)
    if qualified and _known_catalogue(qualified[1]):
        name, catalogues = qualified[2], [qualified[1]]
    found = _named_glass(name, catalogues, pair, place)
    _compare(found, pair, place)
    return found


def glass_line(material: object, place: str) -> list[str]:
    """Return the GLAS line of a medium, none for air; `read_glass` reads it back.

    Raises:
        InputError: the medium is none that a prescription names.
    """
    medium = _medium(material, place)
    name = medium.name
    if name in ("air", "occluder"):
        return []
    if medium is MIRROR:
        return ["  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0"]
    _, colon, word = name.partition(":")
    if colon:
        nd, vd = _index_and_abbe_number(medium) or (1.5, 40.0)
        vd = vd if abs(vd) < 1e4 else 0.0
        return [f"  GLAS {word} 0 0 {nd:.8f} {vd:.6f} 0 0 0 0 0 0"]
    pair = _PAIR.fullmatch(name)
    index, abbe, deviation = (pair[1], pair[2], pair[3]) if pair else (name, "0", "0")
    if deviation is None:
        deviation = f"{_deviation_of_two_terms(abbe):.12f}"
    return [f"  GLAS {_BLANK} 1 0 {index} {abbe} {deviation} 0 0 0 0 0"]


def catalogue_line(materials: Sequence[object], where: str) -> list[str]:
    """Return the GCAT line of a file with these media: an order in which every name means its
    glass.

    Raises:
        InputError: there is no such order, because two catalogues' glasses share their names.
    """
    names = sorted({canonical(str(material)) for material in materials})
    glasses = [(name.partition(":")[0], name.partition(":")[2]) for name in names if ":" in name]
    if not glasses:
        return []

    def must_precede(catalogue: str, word: str, other: str) -> bool:
        return other in makers_of(word) or _may_have_another(other, word, f"{catalogue}:{word}")

    order = catalogue_order(glasses, must_precede)
    if order is None:
        raise InputError(
            f"{where}: a .zmx file cannot hold {', '.join(f'{c}:{w}' for c, w in glasses)} "
            "together: its GCAT names catalogues, and whichever comes first has, or may have, "
            "another glass of the same name"
        )
    return [f"GCAT {' '.join(order)}"]


def _picked_up(
    words: Sequence[str], place: str, surfaces: Sequence[Sequence[str]]
) -> Sequence[str]:
    """Return the words of the surface that a glass is picked up from; the same without pick-up."""
    for _ in range(len(surfaces) + 1):
        if len(words) < 3 or words[1] != _PICKUP:
            return words
        number = number_in_text(words[2], f"{place}: GLAS {words[0]}: pick-up")
        if number not in range(len(surfaces)):
            if words[0] == _BLANK:
                break
            # Part of a file: the name is what the pick-up gave.
            return [words[0], "0", *words[2:]]
        words = surfaces[int(number)]
    raise InputError(f"{place}: GLAS picks up from surface {words[2]}, which has no glass to give")


def _model(words: Sequence[str], place: str) -> str:
    if len(words) < 5:
        raise InputError(f"{place} needs nd and Vd: '{_BLANK} 1 0 nd Vd'")
    nd, vd = (_plain(word, place) for word in words[3:5])
    deviation = _plain(words[5], place) if len(words) > 5 else "0"
    if not abs(float(deviation)) <= LARGEST_DEVIATION:
        raise InputError(f"{place}: ΔPgF must be from -1 to 1, not {deviation}")
    if float(vd) != 0.0 and abs(float(deviation) - _deviation_of_two_terms(vd)) < _SAME_DEVIATION:
        return f"{nd}/{vd}"
    return _with_vd(nd, vd, deviation)


def _with_vd(nd: str, vd: str, deviation: str) -> str:
    return nd if float(vd) == 0.0 else f"{nd}/{vd}/{deviation}"


def _deviation_of_two_terms(vd: str) -> float:
    return deviation_of_two_terms(float(vd), index_model("dfc").lines)


def _printed(words: Sequence[str], place: str) -> Pair | None:
    """Return the nd and Vd beside a name, where the program that wrote the file filled them in."""
    if len(words) < 5:
        return None
    nd, vd = (number_in_text(word, place) for word in words[3:5])
    return None if nd in _NOT_GIVEN or vd <= 0.0 else (words[3], words[4])


def _compare(found: str, pair: Pair | None, place: str) -> None:
    """Log that nd and Vd of a line are not those of the glass that it names, if they are far."""
    own = _index_and_abbe_number(find_glass(found)) if pair else None
    if pair is None or own is None:
        return
    nd, vd = (float(text) for text in pair)
    if abs(nd - own[0]) > _FAR_ND or abs(vd - own[1]) > _FAR_VD:
        logger.warning(
            "%s: nd %s and Vd %s of its line are not those of %s, %.5f and %.2f, which is used",
            *(place, *pair, found, *own),
        )


def _medium(material: object, place: str) -> Medium:
    refused = f"{place}: a .zmx file cannot hold material '{material}'"
    try:
        found = parse_material(str(material), index_model("dfc"))
    except InputError as error:
        raise InputError(f"{refused}: {error}") from None
    if isinstance(found, Uniaxial):
        raise InputError(f"{refused}: a birefringent medium is not held")
    return found


def _plain(word: str, place: str) -> str:
    """Return decimal text without an exponent; unchanged where it has none."""
    value = number_in_text(word, place)
    return word if word.replace(".", "", 1).isdecimal() and word[-1] != "." else f"{value!r}"
