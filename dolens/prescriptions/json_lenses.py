"""Lenses in JSON: dolens's own prescriptions, and the files of Optiland, DeepLens and ray-optics.

What a file is of follows from its keys.  Numbers are the nearest doubles of their decimals; an
infinite number is `Infinity`, as those programs write it, or the text `"inf"`, as dolens does.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.deeplens_json import read_deeplens
from dolens.prescriptions.optiland_json import read_optiland
from dolens.prescriptions.other_programs import ReadPrescription
from dolens.prescriptions.plain_values import Watched, passed_over
from dolens.prescriptions.ray_optics_json import read_ray_optics

# Longer text is no number that a program writes, and is slow to read.
_LONGEST_NUMBER = 400
_DEEPEST = 100


def read_json(text: str, where: str) -> ReadPrescription:
    """Read a lens in JSON.

    Raises:
        InputError: it is not valid JSON, a key is given twice, or no known program wrote it.
    """
    content = _content(text, where)
    if not isinstance(content, dict):
        raise InputError(f"{where}: expected a mapping of keys to values, not {_kind(content)}")
    for holds, read in _READERS:
        if holds(content):
            if read is _own:
                return read(content, where)
            watched = Watched(content)
            prescription, more = read(watched, where)
            return ReadPrescription(prescription, [*more, *passed_over(watched)])
    keys = ", ".join(list(content)[:5]) or "none"
    raise InputError(
        f"{where}: no program that is known here writes lenses with the keys {keys} (allowed: "
        "prescriptions of dolens, and files of Optiland, DeepLens and ray-optics)"
    )


def json_of(prescription: Mapping[str, Any], where: str) -> bytes:
    """Write a prescription as JSON, with the keys that YAML has; reading gives the same bits."""
    text = json.dumps(_written(prescription), indent=2, ensure_ascii=False, allow_nan=False)
    return f"{text}\n".encode()


def _own(content: dict[str, Any], where: str) -> ReadPrescription:
    return ReadPrescription(content, [])


def _is_own(content: dict[str, Any]) -> bool:
    return isinstance(content.get("surfaces"), dict)


def _is_optiland(content: dict[str, Any]) -> bool:
    return "surface_group" in content


def _is_deeplens(content: dict[str, Any]) -> bool:
    surfaces = content.get("surfaces")
    if not isinstance(surfaces, list) or not surfaces or not isinstance(surfaces[0], dict):
        return False
    return "type" in surfaces[0] and any("d_next" in s for s in surfaces if isinstance(s, dict))


def _is_ray_optics(content: dict[str, Any]) -> bool:
    return "optical_model" in content


_READERS: tuple[
    tuple[Callable[[dict[str, Any]], bool], Callable[[dict[str, Any], str], ReadPrescription]], ...
] = (
    (_is_own, _own),
    (_is_optiland, read_optiland),
    (_is_deeplens, read_deeplens),
    (_is_ray_optics, read_ray_optics),
)


def _content(text: str, where: str) -> Any:
    try:
        content = json.loads(
            text,
            object_pairs_hook=_mapping,
            parse_int=_integer,
            parse_float=_number,
        )
        level = [content]
        for _ in range(_DEEPEST):
            level = [entry for value in level for entry in _entries(value)]
        if level:
            raise RecursionError
        if "\\u" in text:
            json.dumps(content, ensure_ascii=False).encode()  # raises at half of a surrogate pair
        return content
    except RecursionError:
        raise InputError(f"{where}: is not valid JSON (it is nested too deeply)") from None
    except ValueError as error:
        raise InputError(f"{where}: is not valid JSON ({error})") from None


def _entries(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        twice = next(key for key in counts if counts[key] > 1)
        raise ValueError(f"key '{twice}' is given twice")
    return found


def _integer(text: str) -> int:
    if len(text) > _LONGEST_NUMBER:
        raise ValueError(f"a number of {len(text)} letters")
    return int(text)


def _number(text: str) -> float:
    if len(text) > _LONGEST_NUMBER:
        raise ValueError(f"a number of {len(text)} letters")
    return float(text)


def _kind(content: object) -> str:
    kinds = {list: "a list", str: "a text", type(None): "nothing", bool: "a truth value"}
    return kinds.get(type(content), "a number")


def _written(value: Any) -> Any:
    """Return plain values that JSON can hold: infinities become texts."""
    if isinstance(value, Mapping):
        return {str(key): _written(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_written(entry) for entry in value]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    return value
