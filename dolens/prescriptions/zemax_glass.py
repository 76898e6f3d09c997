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

from dolens.errors import InputError
from dolens.optics.dispersion import deviation_of_two_terms
from dolens.optics.glass_catalog import find_glass, makers_of
from dolens.optics.materials import LARGEST_DEVIATION, MIRROR, Medium, index_model, parse_material
from dolens.prescriptions.decimals import number_in_text
from dolens.prescriptions.glass_order import catalogue_order
from dolens.prescriptions.media import canonical
from dolens.prescriptions.zemax_catalogues import (
    Pair,
    index_and_abbe_number,
    known_catalogue,
    may_have_another,
    named_glass,
)

logger = logging.getLogger(__name__)

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
    if qualified and known_catalogue(qualified[1]):
        name, catalogues = qualified[2], [qualified[1]]
    found = named_glass(name, catalogues, pair, place)
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
        nd, vd = index_and_abbe_number(medium) or (1.5, 40.0)
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
        return other in makers_of(word) or may_have_another(other, word, f"{catalogue}:{word}")

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
    own = index_and_abbe_number(find_glass(found)) if pair else None
    if pair is None or own is None:
        return
    nd, vd = (float(text) for text in pair)
    if abs(nd - own[0]) > _FAR_ND or abs(vd - own[1]) > _FAR_VD:
        logger.warning(
            "%s: nd %s and Vd %s of its line are not those of %s, %.5f and %.2f, which is used",
            *(place, *pair, found, *own),
        )


def _medium(material: object, place: str) -> Medium:
    try:
        return parse_material(str(material), index_model("dfc"))
    except InputError as error:
        raise InputError(
            f"{place}: a .zmx file cannot hold material '{material}': {error}"
        ) from None


def _plain(word: str, place: str) -> str:
    """Return decimal text without an exponent; unchanged where it has none."""
    value = number_in_text(word, place)
    return word if word.replace(".", "", 1).isdecimal() and word[-1] != "." else f"{value!r}"
