"""The lens format of diffoptics, the program of dO, has one row a surface.

    Cooke triplet
    type distance roc diameter material
    O 0      0      0    AIR
    S 0      22.014 19.0 1.6204/60.31
    S 3.259 -435.76 19.0 AIR
    ...
    I 42.208 0      36.346 AIR

A row has a letter (O object, S conic or even asphere, A aperture, X XY polynomial, I sensor), the
distance from the row before, radius of curvature (0 is a plane), diameter and the medium behind.
Behind them S may have a conic constant and coefficients from r⁴; X has b and the ten coefficients
of x^i·y^(j-i), j = 0..3, i = 0..j.  B (spline) and M (mixed) rows are refused.

Diffoptics skips the first two lines.  What its rows cannot say (index model, stop,
fields, and which surfaces are more than a bare S) stands behind a # in the second, as JSON.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError, check_keys, comma_hint, did_you_mean
from dolens.prescriptions.numbers import (
    as_number,
    curvature_in_text,
    number_in_text,
    reciprocal,
    require_mapping,
)
from dolens.prescriptions.other_programs import require_same
from dolens.prescriptions.system_data import SYSTEM_DATA_KEYS

_COLUMNS = "type distance roc diameter material"
# Far more than an asphere has coefficients.
_MOST_COLUMNS = 1000
_LETTERS = {"plane": "S", "sphere": "S", "conic": "S", "even_asphere": "S"}
_LETTERS |= {"aperture": "A", "xy_polynomial": "X"}
_HEADER_KEYS = ("source", "index_model", "stop", *SYSTEM_DATA_KEYS)
_MONOMIALS = ("", "y", "x", "y2", "xy", "x2", "y3", "xy2", "x2y", "x3")
_COMMON = ("type", "radius", "curvature", "semi_diameter", "thickness", "material")
_MEDIA = {"air": "air", "occluder": "occluder", "vacuum": "occluder"}
_PAIR = re.compile(r"\d+(\.\d+)?/\d+(\.\d+)?")


def prescription_from_diffoptics(text: str, where: str = "lens") -> dict[str, Any]:
    """Read a lens in the diffoptics format.

    The index model is `do` unless the second line says otherwise: the numbers of such files were
    chosen with that program's indices, so it is what reproduces them.  The stop is the first A
    row, else surface 1.  The object's row gives the medium before surface 1; its distance and
    diameter, which diffoptics skips too, are not read.

    Args:
        text: the file's content.
        where: name in messages, usually its path.

    Raises:
        InputError: one line that names `where`, the line, and what is allowed.
    """
    lines = text.splitlines()
    if len(lines) < 2 or not lines[1].strip().lower().startswith("type"):
        raise InputError(f"{where}: line 2 must name the columns: '{_COLUMNS}'")
    header = _header(lines[1], f"{where}: line 2")
    shapes = header.pop("surfaces", {})
    prescription: dict[str, Any] = {"name": lines[0].strip()} if lines[0].strip() else {}
    prescription |= {"index_model": "do", **header}
    rows: dict[str, dict[str, Any]] = {}
    sensor: dict[str, Any] | None = None
    for at, line in enumerate(lines[2:], 3):
        words = line.split()
        if not words:
            continue
        place = f"{where}: line {at}"
        if sensor is not None:
            raise InputError(f"{place}: nothing may follow the sensor's row, I")
        letter, (distance, diameter), material = _columns(words, place)
        if letter == "O":
            if rows:
                raise InputError(f"{place}: the object's row, O, must be the first")
            prescription["object_material"] = material
            continue
        if rows:
            rows[str(len(rows))]["thickness"] = distance
        elif distance != 0.0:
            raise InputError(
                f"{place}: 'distance' of the first surface must be 0, not {words[1]}: "
                "its vertex is the origin"
            )
        if letter == "I":
            _require_plane(words, place, "the sensor")
            sensor = {"distance": distance, **({"diameter": diameter} if diameter else {})}
            continue
        n = str(len(rows) + 1)
        shape = _shape(letter, words, shapes.pop(n, {}), place)
        rows[n] = {**shape, "semi_diameter": diameter / 2.0, "material": material}
        if letter == "A":
            prescription.setdefault("stop", int(n))
    if sensor is None or not rows:
        raise InputError(f"{where}: a lens needs a surface and then the sensor's row, I")
    if shapes:
        raise InputError(f"{where}: line 2: there is no surface {next(iter(shapes))}")
    rows[str(len(rows))].pop("thickness")
    return {**prescription, "surfaces": rows, "sensor": sensor}


def object_radius(text: str, where: str) -> float:
    """Return the radius (mm) of the object's row, O, of a file that was read; infinite for a plane,
    or where there is no such row.
    """
    for at, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if at > 2 and words[:1] == ["O"]:
            return number_in_text(words[2], f"{where}: line {at}: 'roc'") or math.inf
    return math.inf


def diffoptics_text_of(prescription: Mapping[str, Any], where: str = "lens") -> str:
    """Write a prescription in the diffoptics format.

    Raises:
        InputError: one line that names the surface and key which the format cannot hold.
    """
    surfaces = {str(n): row for n, row in prescription["surfaces"].items()}
    header = {"index_model": "dfc"}
    header |= {key: prescription[key] for key in _HEADER_KEYS if prescription.get(key) is not None}
    sensor = prescription["sensor"]
    before = prescription.get("object_material", "air")
    lines = [_line("O", 0.0, "0", 0.0, before, f"{where}: object")]
    shapes: dict[str, dict[str, Any]] = {}
    distance = 0.0
    for n, row in surfaces.items():
        place = f"{where}: surface {n}"
        kind = str(row.get("type", "sphere"))
        if kind not in _LETTERS:
            raise InputError(
                f"{place}: a .txt file cannot hold type '{kind}' (allowed: {', '.join(_LETTERS)})"
            )
        if row.get("semi_diameter") is None:
            raise InputError(f"{place}: 'semi_diameter' is missing (mm)")
        diameter = 2.0 * as_number(row["semi_diameter"], f"{place}: 'semi_diameter'")
        letter, roc = _LETTERS[kind], _roc(row, place)
        line = _line(letter, distance, roc, diameter, row.get("material"), place)
        lines.append(" ".join((line, *_more(kind, row, place))))
        bare = _shape(letter, lines[-1].split(), {}, place)
        names = [key for key in row if key not in _COMMON]
        if bare["type"] != kind or {*bare} - {*_COMMON} != {*names}:
            shapes[n] = {"type": kind, "parameters": names}
        distance = as_number(row.get("thickness", sensor["distance"]), f"{place}: 'thickness'")
    lines.append(
        _line("I", distance, "0", as_number(sensor.get("diameter") or 0.0, where), "air", where)
    )
    extra = json.dumps({**header, **({"surfaces": shapes} if shapes else {})})
    text = "\n".join((str(prescription.get("name", "")), f"{_COLUMNS} # {extra}", *lines, ""))
    require_same(prescription, prescription_from_diffoptics(text, where), ".txt", where)
    return text


def _header(line: str, place: str) -> dict[str, Any]:
    """Read the text behind a # in the second line; other programs' remarks are ignored."""
    _, _, extra = line.partition("#")
    if not extra.strip().startswith("{"):
        return {}
    try:
        header = json.loads(extra)
    except (ValueError, RecursionError):
        raise InputError(f"{place}: the text behind # is not valid JSON") from None
    check_keys(header, (*_HEADER_KEYS, "surfaces"), place)
    shapes = header.get("surfaces", {})
    require_mapping(shapes, f"{place}: surfaces")
    for n, shape in shapes.items():
        require_mapping(shape, f"{place}: surface {n}")
        check_keys(shape, ("type", "parameters"), f"{place}: surface {n}")
        if not isinstance(shape.get("parameters", []), list):
            raise InputError(f"{place}: surface {n}: 'parameters' must be a list of names")
    return header


def _columns(words: list[str], place: str) -> tuple[str, tuple[float, float], str]:
    """Return letter, distance and diameter, and medium of a row."""
    letter = words[0]
    if letter not in ("O", "S", "A", "X", "I"):
        raise InputError(f"{place}: row type '{letter}' cannot be read (allowed: O, S, A, X and I)")
    if len(words) < 5:
        raise InputError(f"{place}: a row has at least the columns '{_COLUMNS}'")
    if len(words) > _MOST_COLUMNS:
        raise InputError(f"{place}: has {len(words)} columns (allowed: {_MOST_COLUMNS} at most)")
    if len(words) > 5 and letter in "OAI":
        raise InputError(f"{place}: a row of type {letter} ends with its material")
    distance = number_in_text(words[1], f"{place}: 'distance'")
    diameter = number_in_text(words[3], f"{place}: 'diameter'")
    return letter, (distance, diameter), _diffoptics_material(words[4], place)


def _shape(letter: str, words: list[str], said: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return type, radius and coefficients of a surface's row; `said` holds the header's values for
    it.
    """
    values = [number_in_text(word, f"{place}: column {6 + i}") for i, word in enumerate(words[5:])]
    if letter == "A":
        _require_plane(words, place, "an aperture")
        kind, found = "aperture", {}
    elif letter == "X":
        _require_plane(words, place, "an XY polynomial's base")
        if len(values) != 1 + len(_MONOMIALS):
            raise InputError(f"{place}: an X row has b and ten coefficients, not {len(values)}")
        if values[1] != 0.0:
            raise InputError(f"{place}: the constant term must be 0, not {words[6]}")
        kind, found = "xy_polynomial", dict(zip(_MONOMIALS[1:], values[2:], strict=True))
        found["b"] = values[0]
    else:
        kind = ("sphere", "conic", "even_asphere")[min(len(values), 2)]
        found = {f"a{2 * i + 2}" if i else "conic": value for i, value in enumerate(values)}
    wanted = str(said.get("type", kind))
    if _LETTERS.get(wanted) != letter:
        raise InputError(f"{place}: line 2 calls this row of type {letter} a '{wanted}'")
    names = [str(name) for name in said.get("parameters", found)]
    kept = set(names)
    for name in (*found, *names):
        if (name in found) != (name in kept) and found.get(name):
            raise InputError(f"{place}: line 2 leaves out '{name}', which is {found[name]!r}")
    row: dict[str, Any] = {"type": wanted}
    if wanted == "plane":
        _require_plane(words, place, "a plane")
    elif letter == "S":
        curvature = curvature_in_text(words[2], f"{place}: 'roc'")
        radius = number_in_text(words[2], f"{place}: 'roc'") or float("inf")
        row |= {"radius": radius} if curvature is None else {"curvature": curvature}
    return row | {name: found.get(name, 0.0) for name in names}


def _require_plane(words: list[str], place: str, what: str) -> None:
    if number_in_text(words[2], f"{place}: 'roc'") != 0.0:
        raise InputError(f"{place}: {what} must be flat, with 'roc' 0, not {words[2]}")


def _line(
    letter: str, distance: float, roc: str, diameter: float, material: object, place: str
) -> str:
    name = str(material)
    written = name.upper() if name in ("air", "occluder") else name
    try:
        held = _diffoptics_material(written, place) == name
    except InputError:
        held = False
    if not held:
        raise InputError(
            f"{place}: a .txt file cannot hold material '{name}' (allowed: nd/Vd, air, occluder)"
        )
    return f"{letter} {distance!r} {roc} {diameter!r} {written}"


def _roc(row: Mapping[str, Any], place: str) -> str:
    if row.get("curvature") is not None:
        curvature = as_number(row["curvature"], f"{place}: 'curvature'")
        return "0" if curvature == 0.0 else reciprocal(curvature)
    radius = as_number(row.get("radius", float("inf")), f"{place}: 'radius'", finite=False)
    return "0" if abs(radius) == float("inf") else repr(radius)


def _more(kind: str, row: Mapping[str, Any], place: str) -> list[str]:
    """Read the columns behind the material."""
    if kind == "xy_polynomial":
        names = ["b", *_MONOMIALS]
    elif kind == "even_asphere":
        powers = [int(key[1:]) for key in row if key[:1] == "a" and key[1:].isdecimal()]
        names = ["conic", *(f"a{power}" for power in range(4, max(powers, default=2) + 1, 2))]
    else:
        names = ["conic"] if kind == "conic" else []
    return [repr(as_number(row.get(name, 0.0), f"{place}: '{name}'")) for name in names]


# nd/Vd as diffoptics tabulates them (its index model counts them from 589.3 nm).
DIFFOPTICS_GLASSES = {
    "b270": "1.52290/58.50",
    "baf10": "1.67/47.05",
    "bk10": "1.49780/66.954",
    "d-k59": "1.5175/63.50",
    "f15": "1.60570/37.831",
    "f2": "1.620/36.37",
    "flint": "1.6200/36.37",
    "n-baf10": "1.67003/47.11",
    "n-bk7": "1.51680/64.17",
    "n-sf1": "1.71736/29.62",
    "n-sf10": "1.72828/28.53",
    "n-sf11": "1.78472/25.68",
    "n-sf2": "1.64769/33.82",
    "n-sf4": "1.75513/27.38",
    "n-sf5": "1.67271/32.25",
    "n-sf6": "1.80518/25.36",
    "n-sf6ht": "1.80518/25.36",
    "n-sf8": "1.68894/31.31",
    "pmma": "1.491756/58.00",
    "polycarb": "1.585470/30.00",
    "s-nph1": "1.8078/22.76",
    "sf1": "1.71736/29.51",
    "sf18": "1.72150/29.245",
    "sf2": "1.64769/33.85",
    "sf4": "1.75520/27.58",
    "sf5": "1.67270/32.21",
    "sf6": "1.80518/25.43",
    "sk1": "1.61030/56.712",
    "sk16": "1.62040/60.306",
    "ssk4": "1.61770/55.116",
    "uvfs": "1.458/67.82",
}


def _diffoptics_material(name: str, place: str) -> str:
    """Return a medium of the diffoptics format as a prescription writes it.

    A name stands for diffoptics's own nd and Vd, not for a catalogue's dispersion.  Vacuum is the
    medium that a prescription writes `occluder`: index 1 in every index model.

    Raises:
        InputError: one line that names the place and a near name.
    """
    word = name.lower()
    known = _MEDIA | DIFFOPTICS_GLASSES
    if word not in known and not _PAIR.fullmatch(word):
        raise InputError(
            f"{place}: material '{name}' is unknown{did_you_mean(word, known)} (allowed: nd/Vd, "
            "such as 1.5168/64.17, air, occluder, vacuum, or a glass in diffoptics's own table)"
            f"{comma_hint(name)}"
        )
    return known.get(word, word)
