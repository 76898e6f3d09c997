"""The glass of a Zemax surface is a model (nd and Vd), or a name in the catalogues of the file.

`GCAT` lists the catalogues that a file uses, and Zemax takes a name from the first that has it.
Here a name is read from that catalogue too, or refused: the same name at another maker is another
glass.  `GLAS name 0 0 nd Vd` repeats nd and Vd, which Zemax fills in or leaves at 1.5 and 40; where
they are filled in they must be those of the glass found.

A catalogue here is a maker's (SCHOTT_2000 and CDGM-ZEMAX are editions of the makers' own) or MISC,
whose plastics are read as the measurements of the same plastics here.  Others are not known: where
one may hold a name too and stands before the maker that has it, nd and Vd must agree.  A file
without GCAT gives a name that one maker alone uses, or the only glass of that name whose nd and Vd
agree.
"""

import itertools
import re
from collections.abc import Sequence
from decimal import Decimal

from dolens.errors import InputError
from dolens.optics.glass_catalog import find_glass, is_old_name, makers_of
from dolens.optics.materials import (
    Material,
    Medium,
    abbe_number,
    index_d,
    index_model,
    parse_material,
)
from dolens.optics.mirrors import MIRROR
from dolens.prescriptions.decimals import number_in_text

# Zemax prints what its catalogue gives: half of what tells Schott's F2 from Hikari's.  Where a file
# prints fewer decimals, half a unit of the last.
_ND, _VD = 5e-5, 0.02
# Zemax leaves nd at 1.5, other programs at 0 or 1, where a name says it all.
_NOT_GIVEN = (0.0, 1.0, 1.5)
_MISC = "MISC"
# What Zemax calls the plastics of its catalogue MISC.
_PLASTICS = {"POLYCARBONATE": "POLYCARB", "POLYSTYRENE": "POLYSTYR", "ZEONEX-E48R": "E48R"}
_MAKERS = ("SCHOTT", "OHARA", "HOYA", "CDGM", "SUMITA", "HIKARI", "NIKON-HIKARI")
# Their glasses have names of their own schemes alone.
_OWN_NAMES = ("OHARA", "SUMITA")
_PAIR = re.compile(r"\s*([\d.]+)\s*/\s*([\d.]+)\s*")

Pair = tuple[str, str]


def read_glass(words: Sequence[str], catalogues: Sequence[str] | None, place: str) -> str:
    """Return the medium that the arguments of GLAS name, as a prescription writes it.

    Args:
        words: name, kind of solve (1 is a model), pick-up, nd, Vd, ...; none is air.
        catalogues: the arguments of GCAT; None where the file has none.
        place: name of the surface in messages.

    Returns:
        `air`, `mirror`, nd/Vd, a constant index (a model whose Vd is 0), or maker and name.

    Raises:
        InputError: half a model, or a name that cannot be read as the file means it.
    """
    if not words or words[0].upper() == "AIR":
        return "air"
    name, how = words[0], words[1] if len(words) > 1 else "0"
    if name.upper() == "MIRROR":
        return MIRROR.name
    place = f"{place}: GLAS {name}"
    if name == "___BLANK" or how == "1":
        return _model(words, place)
    if how == "4" and any(number_in_text(w, place) for w in words[9:11]):
        raise InputError(f"{place} with offsets of nd or Vd is not held")
    pair = _printed(words, place)
    found = _named(name, catalogues, pair, place)
    if pair and _agrees(found, pair) is False:
        glass = find_glass(found)
        raise InputError(
            f"{place}: nd {pair[0]} and Vd {pair[1]} of its line are not those of {found}, "
            f"{index_d(glass):.5f} and {abbe_number(glass):.2f}; {_instead(pair)}"
        )
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
    if isinstance(medium, Material):
        pair = _PAIR.fullmatch(name)
        nd, vd = (pair[1], pair[2]) if pair else (name, "0")
        return [f"  GLAS ___BLANK 1 0 {nd} {vd} 0 0 0 0 0 0"]
    maker, _, word = name.rpartition(":")
    word = _PLASTICS.get(word, word) if maker == "PLASTIC" else word
    nd, vd = _index_and_abbe_number(medium) or (1.5, 40.0)
    return [f"  GLAS {word} 0 0 {nd:.8f} {vd:.6f} 0 0 0 0 0 0"]


def canonical(material: str) -> str:
    """Return one name for a medium in a `.zmx` file, in which `occluder` is air; unchanged if
    none.
    """
    try:
        name = parse_material(material, index_model("dfc")).name
    except InputError:
        return material
    return "air" if name == "occluder" else name


def catalogue_line(materials: Sequence[object], where: str) -> list[str]:
    """Return the GCAT line of a file with these media: an order in which every name means its
    glass.

    Raises:
        InputError: there is no such order, because two makers' glasses share their names.
    """
    names = sorted({canonical(str(material)) for material in materials})
    glasses = {name: name.partition(":") for name in names if ":" in name}
    used = sorted({_MISC if maker == "PLASTIC" else maker for maker, _, _ in glasses.values()})
    if not used:
        return []
    for order in itertools.permutations(used):
        try:
            if all(_named(word, order, None, where) == n for n, (_, _, word) in glasses.items()):
                return [f"GCAT {' '.join(order)}"]
        except InputError:
            continue
    raise InputError(
        f"{where}: a .zmx file cannot hold {', '.join(glasses)} together: its GCAT names "
        "catalogues, and whichever comes first has, or may have, another glass of the same name"
    )


def _model(words: Sequence[str], place: str) -> str:
    if len(words) < 5:
        raise InputError(f"{place} needs nd and Vd: '___BLANK 1 0 nd Vd'")
    if len(words) > 5 and number_in_text(words[5], place):
        raise InputError(f"{place}: the deviation of its dispersion (ΔPgF) must be 0")
    nd, vd = (_plain(word, place) for word in words[3:5])
    return nd if float(vd) == 0.0 else f"{nd}/{vd}"


def _printed(words: Sequence[str], place: str) -> Pair | None:
    """Return the nd and Vd beside a name, where the program that wrote the file filled them in."""
    if len(words) < 5:
        return None
    nd, vd = (number_in_text(word, place) for word in words[3:5])
    return None if nd in _NOT_GIVEN or vd <= 0.0 else (words[3], words[4])


def _named(name: str, catalogues: Sequence[str] | None, pair: Pair | None, place: str) -> str:
    """Return maker and name of the glass that a file means."""
    makers = makers_of(name)
    if catalogues is None:
        agreeing = [m for m in makers if pair and _agrees(_of(m, name), pair)]
        if len(agreeing) == 1:
            return _of(agreeing[0], name)
        try:
            return find_glass(name).name
        except InputError as error:
            if not makers:
                raise InputError(f"{place}: {error}; {_instead(pair)}") from None
            raise InputError(
                f"{place}: the file has no GCAT, and several makers gave that name "
                f"(here: {', '.join(makers)}); add GCAT with the maker meant; {_instead(pair)}"
            ) from None
    doubtful = []
    for catalogue in catalogues:
        maker = _maker(catalogue)
        if maker in makers:
            found = _of(maker, name)
            if doubtful and not (pair and _agrees(found, pair)):
                raise InputError(
                    f"{place}: {' and '.join(doubtful)}, which GCAT names before {catalogue}, may "
                    f"have another glass of that name that is not known here; {_instead(pair)}"
                )
            return found
        if _may_have(catalogue, maker, name):
            doubtful.append(catalogue)
    elsewhere = f"; {' and '.join(makers)} has another of that name" if makers else ""
    raise InputError(
        f"{place} is in none of the file's catalogues as they are known here (GCAT "
        f"{' '.join(catalogues)}){elsewhere}; {_instead(pair)}"
    )


def _maker(catalogue: str) -> str | None:
    """Return the maker whose glasses a catalogue of Zemax holds; editions have a suffix."""
    word = catalogue.upper()
    if word == _MISC:
        return "PLASTIC"
    known = next((m for m in _MAKERS if re.fullmatch(rf"{m}([-_].*)?", word)), None)
    return known.rpartition("-")[2] if known else None


def _may_have(catalogue: str, maker: str | None, name: str) -> bool:
    """Return whether a catalogue may have a glass of that name, which is not known here.

    Makers' modern names have a hyphen and are theirs alone.  MISC has no such names, and some that
    are glasses elsewhere (LAF3 is lanthanum fluoride there).
    """
    if maker is None:
        return True
    if maker == "PLASTIC":
        return "-" not in name
    return is_old_name(name) and maker not in _OWN_NAMES


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
    try:
        return index_d(medium), abbe_number(medium)
    except InputError:
        return None


def _of(maker: str, name: str) -> str:
    return find_glass(f"{maker}:{name}").name


def _instead(pair: Pair | None) -> str:
    nd, vd = pair or ("nd", "Vd")
    return f"for a glass by its nd and Vd write GLAS ___BLANK 1 0 {nd} {vd}"


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
