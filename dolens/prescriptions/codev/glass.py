"""The glass of a CODE V surface has a name and a maker, a code, or a private table of indices.

CODE V writes names without hyphens and blanks, and the maker behind them: `NBK7_SCHOTT`.  A code
has the digits of nd - 1 and of Vd: `517642`, `517.642` and `516800.641700`.
"""

import re
from collections.abc import Mapping
from decimal import Decimal
from itertools import combinations, pairwise

from dolens.errors import InputError, comma_hint
from dolens.optics.glass_catalog import find_glass, likely_makers, makers_of
from dolens.optics.materials import abbe_number, index_model, parse_material
from dolens.prescriptions.codev.file import CodeVFile, unquoted
from dolens.prescriptions.numbers import number_in_text

_SIX_DIGITS = re.compile(r"(\d{3})(\d{3})")
_CODE = re.compile(r"(\d{1,8})\.(\d{1,8})")
_PAIR = re.compile(r"([12](?:\.\d+)?):(\d+(?:\.\d+)?)")
# CODE V's names of catalogues → makers as they are called here.
_MAKERS = {
    "SCHOTT": ("SCHOTT",),
    "OHARA": ("OHARA",),
    "HOYA": ("HOYA",),
    "HIKARI": ("HIKARI",),
    "NIKON": ("HIKARI",),
    "SUMITA": ("SUMITA",),
    "CDGM": ("CDGM",),
}
# The lines d, F and C as catalogues print them, nm.
_LINES = ((587.5618, 587.6), (486.1327, 486.1), (656.2725, 656.3))


def read_glass(word: str, file: CodeVFile, used: tuple[float, float], place: str) -> str:
    """Return the medium that a word names, as a prescription writes it.

    Args:
        word: as it is written; empty for air.
        file: with its private glasses.
        used: the shortest and the longest wavelength of the file, nm.
        place: name of the surface in messages.

    Raises:
        InputError: no glass has the name, several have, or a private glass has no equal here.
    """
    name = unquoted(word).strip()
    if name.upper() in ("", "AIR"):
        return "air"
    if name.upper() in file.private:
        return _private(name.upper(), file, used, f"{place}: private glass '{name}'")
    return glass_by_name_or_code(name, place)


def glass_by_name_or_code(name: str, place: str) -> str:
    """Return the medium that a name (`NBK7_SCHOTT`, `N-BK7`) or a code (`517.642`) means.

    Raises:
        InputError: no glass has the name, or several have.
    """
    six, code, pair = (form.fullmatch(name) for form in (_SIX_DIGITS, _CODE, _PAIR))
    if six:
        return _pair(f"1.{six[1]}", Decimal(six[2]).scaleb(-1))
    if code:
        return _pair(f"1.{code[1]}", Decimal(f"0.{code[2]}").scaleb(2))
    if pair:
        return f"{pair[1]}/{pair[2]}"
    return _named(name, place)


def glass_word(material: str, place: str) -> str:
    """Return the word that `read_glass` reads as a medium; nothing for air.

    Raises:
        InputError: CODE V has no word for it: it is neither a maker's glass nor nd and Vd of at
            most six and four decimals.
    """
    try:
        name = parse_material(material, index_model("dfc")).name
    except InputError as error:
        raise InputError(f"{place}: a .seq file cannot hold '{material}': {error}") from None
    if name in ("air", "occluder"):
        return ""
    nd, slash, vd = name.partition("/")
    if "/" in vd:
        raise InputError(f"{place}: a .seq file cannot hold ΔPgF of material '{material}'")
    if slash:
        return _code(nd.strip(), vd.strip(), f"{place}: material '{material}'")
    maker, _, word = name.rpartition(":")
    catalogue = next((key for key, makers in _MAKERS.items() if maker in makers), None)
    if catalogue is None:
        raise InputError(
            f"{place}: a .seq file cannot hold material '{material}' "
            f"(allowed: nd/Vd, and glass of {', '.join(_MAKERS)})"
        )
    written = f"{re.sub(r'[^A-Z0-9]', '', word.upper())}_{catalogue}"
    if _named(written, place) != name:
        raise InputError(f"{place}: {written} would come back as another glass than {name}")
    return written


def _code(nd: str, vd: str, place: str) -> str:
    """Write nd and Vd as CODE V's digits."""
    digits = Decimal(nd) - 1
    dispersion = Decimal(vd).scaleb(-2)
    if not (0 < digits < 1 and 0 < dispersion < 1):
        raise InputError(f"{place}: a glass code of CODE V has nd from 1 to 2 and Vd below 100")
    first, second = (format(value.normalize(), "f")[2:] for value in (digits, dispersion))
    if len(first) > 6 or len(second) > 6:
        raise InputError(
            f"{place}: a glass code of CODE V has six decimals of nd and four of Vd at most"
        )
    return f"{first:0<6}.{second:0<6}"


def _pair(nd: str, vd: Decimal) -> str:
    digits = nd.rstrip("0").rstrip(".")
    return f"{digits}/{format(vd.normalize(), 'f')}"


def _named(name: str, place: str) -> str:
    """Return maker and name of a glass whose hyphens CODE V left out."""
    word, _, catalogue = name.upper().rpartition("_")
    if word and catalogue not in _MAKERS:
        raise InputError(
            f"{place}: glass {name}: catalogue {catalogue} is not known here "
            f"(allowed: {', '.join(_MAKERS)}, and codes such as 517.642)"
        )
    makers = _MAKERS.get(catalogue) if word else None
    spelt = word or name.upper()
    found: dict[str, None] = {}
    for candidate in _spellings(spelt):
        for maker in likely_makers(candidate) if makers is None else makers_of(candidate):
            if makers is None or maker in makers:
                found[find_glass(f"{maker}:{candidate}").name] = None
    if not found:
        where = f" of {catalogue}" if word else ""
        raise InputError(
            f"{place}: glass {name} is not known here{where}; write its nd and Vd as a code, such "
            f"as 517.642{comma_hint(name)}"
        )
    if len(found) > 1:
        raise InputError(
            f"{place}: glass {name} may be {' or '.join(found)}; write the catalogue behind it, "
            f"for example {spelt}_{next(iter(found)).partition(':')[0]}"
        )
    return next(iter(found))


def _spellings(word: str) -> list[str]:
    """Return a name with up to two hyphens put in."""
    places = range(1, min(len(word), 16))
    split = [(), *((i,) for i in places), *combinations(places, 2)]
    return ["-".join(_cut(word, at)) for at in split]


def _cut(word: str, at: tuple[int, ...]) -> list[str]:
    ends = (0, *at, len(word))
    return [word[a:b] for a, b in pairwise(ends)]


def _private(name: str, file: CodeVFile, used: tuple[float, float], place: str) -> str:
    """Return a private glass whose table of indices is a constant or that of nd and Vd.

    Raises:
        InputError: it is given by a formula, or no glass by nd and Vd has the table's indices to
            half a unit of their last digits at the wavelengths that the file uses.
    """
    words = file.private[name].words
    if len(words) != len(file.wavelengths) or not words:
        kind = f" by a formula ({words[0]})" if words and not words[0][:1].isdigit() else ""
        raise InputError(
            f"{place}{kind} is not held (allowed: an index for every wavelength of PWL)"
        )
    table = {
        number_in_text(wave, place): word
        for wave, word in zip(file.wavelengths, words, strict=True)
    }
    values = {wave: number_in_text(word, place) for wave, word in table.items()}
    if len(set(values.values())) == 1:
        return repr(next(iter(values.values())))
    near = [
        next((w for w in values if min(abs(w - line) for line in lines) < 0.06), None)
        for lines in _LINES
    ]
    if None in near:
        raise InputError(
            f"{place} has no indices at the lines d, F and C (587.6, 486.1 and 656.3 nm), from "
            "which nd and Vd follow; a table of other wavelengths is not held"
        )
    nd, nf, nc = (Decimal(table[wave]) for wave in near if wave is not None)
    material = f"{nd}/{float((nd - 1) / (nf - nc))!r}"
    medium = parse_material(material, index_model("dfc"))
    for wave, word in table.items():
        half = 0.5 * 10.0 ** min(int(Decimal(word).as_tuple().exponent), 0)
        if (
            used[0] <= wave <= used[1]
            and abs(float(medium.index(wave)) - float(word)) > half * 1.001
        ):
            raise InputError(
                f"{place} has another dispersion than nd and Vd say: {word} at {wave:g} nm, not "
                f"{medium.index(wave):.6f} (nd {nd}, Vd {abbe_number(medium):.2f})"
            )
    return material


def private_glass(material: str) -> Mapping[str, str]:
    """Return name and index of a private glass for a constant index; nothing for other media."""
    try:
        index = float(material)
    except ValueError:
        return {}
    return {f"N{repr(index).replace('.', '_')}": repr(index)}
