"""Lens files in YAML and JSON are plain values: every key once, nothing that names code."""

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from itertools import chain
from typing import Any

import yaml

from dolens.errors import InputError, one_line
from dolens.files import much_at_once
from dolens.prescriptions.numbers import as_number, nearest
from dolens.prescriptions.other_programs import ReadPrescription

# Far more than a lens has; aliases (*name) let a short file mean billions of values.
_MOST_VALUES = 2_000_000
_DEEPEST = 100
# A number of a surface; Python's tables are slow to hold many larger ones.
_LARGEST_KEY = 2**32
# Longer text is no number that a program writes, and is slow to read.
_LONGEST_NUMBER = 400
_TAG = "tag:yaml.org,2002:"
# What a lens is made of; dates, sets and the like are no values of it.
_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")


# The one in C is written for speed, and reads the same.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# `.inf` and `.nan` are Python's words but for the point.
_POINTED = re.compile(r"^([-+]?)\.(inf|nan)$", re.IGNORECASE)
_INTEGER = re.compile(r"^[-+]?[0-9]+$")
_DECIMAL = re.compile(
    r"^[-+]?(?:\.(?:inf|Inf|INF)|(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)$|^\.(?:nan|NaN|NAN)$"
)
_OTHERS = (f"{_TAG}int", f"{_TAG}float", f"{_TAG}timestamp", f"{_TAG}value")
_NOTHING = (None, False, 0, "", "ignore")


class _PlainLoader(_SafeLoader):
    """This safe YAML loader builds plain values only, and reads numbers as decimals.

    YAML's own dates and its numbers to other bases (`0b1`, `1:30`) are texts.  It also refuses a
    key written twice, as the first would be lost, and a file that means too many values.
    """

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _values_in(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"it means more than {_MOST_VALUES} values")
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        scalars = [key for key, _ in pairs if isinstance(key, yaml.ScalarNode)]
        for key_node in scalars:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if isinstance(key, int) and abs(key) > _LARGEST_KEY:
                raise yaml.YAMLError(f"key '{key_node.value}' in line {line} is too large a number")
            if key in seen:
                raise yaml.YAMLError(f"key '{key}' is given twice, again in line {line}")
            seen.add(key)
        return super().construct_mapping(node, deep)


def _construct_number(loader: _PlainLoader, node: yaml.ScalarNode) -> int | float:
    """Return the number of a scalar, which an explicit tag may call one without its being one."""
    text = str(loader.construct_scalar(node))
    kind = int if node.tag == f"{_TAG}int" else float
    if len(text) > _LONGEST_NUMBER:
        reason = f"a number of {len(text)} letters"
    else:
        try:
            return kind(text)
        except ValueError:
            pass
        try:
            return kind(_POINTED.sub(r"\1\2", text))
        except ValueError:
            reason = f"'{text}' is no number"
    raise yaml.constructor.ConstructorError(None, None, reason, node.start_mark)


def _construct_truth(loader: _PlainLoader, node: yaml.ScalarNode) -> bool:
    """Return the truth value of a scalar; a tag may call anything one."""
    text = str(loader.construct_scalar(node))
    if text.lower() not in loader.bool_values:
        reason = f"'{text}' is neither true nor false"
        raise yaml.constructor.ConstructorError(None, None, reason, node.start_mark)
    return bool(loader.bool_values[text.lower()])


_PlainLoader.yaml_constructors = {
    f"{_TAG}{name}": yaml.SafeLoader.yaml_constructors[f"{_TAG}{name}"] for name in _TAGS
} | {None: yaml.SafeLoader.yaml_constructors[None]}
for _name in ("int", "float"):
    _PlainLoader.add_constructor(f"{_TAG}{_name}", _construct_number)
_PlainLoader.add_constructor(f"{_TAG}bool", _construct_truth)
_PlainLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in found if tag not in _OTHERS]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_PlainLoader.add_implicit_resolver(f"{_TAG}int", _INTEGER, list("-+0123456789"))
_PlainLoader.add_implicit_resolver(f"{_TAG}float", _DECIMAL, list("-+.0123456789"))


def read_yaml(text: str, where: str) -> ReadPrescription:
    """Read a prescription in YAML; see `plain_values`."""
    return ReadPrescription(plain_values(text, where), [])


def plain_values(text: str, where: str) -> Any:
    """Read YAML as plain values; nothing in it names code, and no key may be given twice.

    Args:
        text: what the file holds.
        where: its name, for messages.

    Raises:
        InputError: it is not valid YAML; the message is one line.
    """
    try:
        with much_at_once():
            _require_modest(text)
            # A subclass of the safe loader: it builds plain values only.
            return yaml.load(text, Loader=_PlainLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{where}: is not valid YAML ({one_line(error)})") from None


def _require_modest(text: str) -> None:
    """Raise `YAMLError` where text is nested too deeply, or has too many values; it is read event
    by event, and nothing is built.
    """
    depth, values = 0, 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.NodeEvent):
            values += 1
            depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise yaml.YAMLError("it is nested too deeply")
        if values > _MOST_VALUES:
            raise yaml.YAMLError(f"it means more than {_MOST_VALUES} values")


def _values_in(node: yaml.Node, known: dict[int, int]) -> int:
    """Return how many values a node means, aliases and all; too many where it holds itself."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _MOST_VALUES + 1  # until it is counted, for a node that holds itself
        entries = node.value if isinstance(node, yaml.SequenceNode) else chain(*node.value)
        known[id(node)] = 1 + sum(
            1 if isinstance(entry, yaml.ScalarNode) else _values_in(entry, known)
            for entry in entries
        )
    return known[id(node)]


def yaml_of(prescription: Mapping[str, Any], where: str) -> bytes:
    """Write a prescription as YAML."""
    text = yaml.safe_dump(
        prescription, sort_keys=False, default_flow_style=None, width=200, allow_unicode=True
    )
    return text.encode()


def json_content(text: str, where: str) -> dict[str, Any]:
    """Read the mapping that JSON holds.

    Numbers are the nearest doubles of their decimals; an infinite number is `Infinity`, as some
    programs write it, or the text `"inf"`, as dolens does.

    Raises:
        InputError: it is not valid JSON, a key is given twice, or it holds something else.
    """
    content = _json(text, where)
    if not isinstance(content, dict):
        kinds = {list: "a list", str: "a text", type(None): "nothing", bool: "a truth value"}
        kind = kinds.get(type(content), "a number")
        raise InputError(f"{where}: expected a mapping of keys to values, not {kind}")
    return content


def _json(text: str, where: str) -> Any:
    try:
        content = json.loads(
            text,
            object_pairs_hook=_each_key_once,
            parse_int=lambda text: _short(text, int),
            parse_float=lambda text: _short(text, float),
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


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        twice = next(key for key in counts if counts[key] > 1)
        raise ValueError(f"key '{twice}' is given twice")
    return found


def _short(text: str, kind: type[int] | type[float]) -> int | float:
    if len(text) > _LONGEST_NUMBER:
        raise ValueError(f"a number of {len(text)} letters")
    return kind(text)


def json_of(prescription: Mapping[str, Any], where: str) -> bytes:
    """Write a prescription as JSON, with the keys that YAML has; reading gives the same bits."""
    text = json.dumps(_finite(prescription), indent=2, ensure_ascii=False, allow_nan=False)
    return f"{text}\n".encode()


def _finite(value: Any) -> Any:
    """Return plain values that JSON can hold: infinities become texts."""
    if isinstance(value, Mapping):
        return {str(key): _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    return value


class Watched(dict[str, Any]):
    """A `Watched` is a mapping that remembers which of its keys were looked up.

    Args:
        content: the values of another program's file; mappings in them are watched too.
    """

    def __init__(self, content: dict[str, Any]) -> None:
        super().__init__({key: _watched(value) for key, value in content.items()})
        self.seen: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        """Return a value, and remember its key."""
        self.seen.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a value, and remember its key."""
        self.seen.add(key)
        return super().get(key, default)


def _watched(value: Any) -> Any:
    if isinstance(value, list):
        return [_watched(entry) for entry in value]
    return Watched(value) if isinstance(value, dict) else value


def passed_over(content: Watched) -> list[str]:
    """Return the keys that hold something and were not looked up, such as `ray_tracer`.

    Places in lists are left out, so that a key of many surfaces is named once.
    """
    return list(dict.fromkeys(f"'{path}'" for path in _unread(content, "")))


def _unread(value: Any, path: str) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _unread(entry, path)
    if isinstance(value, Watched):
        for key, entry in value.items():
            # Names of classes, and what a program's objects wrap their values in, say nothing.
            inner = path if key == "attributes" else f"{path}.{key}".lstrip(".")
            if key in value.seen or key == "attributes":
                yield from _unread(entry, inner)
            elif not key.startswith("__") and _says(entry):
                yield inner


def _says(value: Any) -> bool:
    """Return whether a value is other than nothing, zero or a mapping or list of such."""
    if isinstance(value, dict):
        return any(map(_says, value.values()))
    return any(map(_says, value)) if isinstance(value, list) else value not in _NOTHING


def mapping(value: object, place: str) -> dict[str, Any]:
    """Return a mapping; `InputError` where a value is none."""
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected a mapping of keys to values")
    return value


def rows(value: object, place: str) -> list[Any]:
    """Return a list; `InputError` where a value is none."""
    if not isinstance(value, list):
        raise InputError(f"{place}: expected a list")
    return value


def number(content: dict[str, Any], key: str, place: str, default: float | None = None) -> float:
    """Return a finite number of a mapping."""
    if content.get(key) is None:
        if default is None:
            raise InputError(f"{place}: '{key}' is missing")
        return default
    return as_number(content[key], f"{place}: '{key}'")


def even_powers(content: dict[str, Any], key: str, place: str, first: int = 1) -> dict[str, float]:
    """Return the coefficients of r² (where it is not zero), r⁴, ... in a list of numbers.

    Args:
        content: of a surface.
        key: of the list; nothing where there is none.
        place: name of the surface in messages.
        first: 2 where the list begins at r⁴.
    """
    values = rows(content.get(key, []), f"{place}: '{key}'")
    numbers = [as_number(value, f"{place}: '{key}'") for value in values]
    found = {f"a{2 * n}": value for n, value in enumerate(numbers, first)}
    if not found.get("a2"):
        found.pop("a2", None)
    return found


def difference(later: float, earlier: float, place: str) -> float:
    """Return the double nearest to the difference of two decimals, for gaps between positions."""
    exact = Fraction(Decimal(repr(later))) - Fraction(Decimal(repr(earlier)))
    return nearest(exact, place)


def require_unset(content: dict[str, Any], keys: Iterable[str], what: str, place: str) -> None:
    """Raise `InputError` where one of some keys says anything."""
    for key in keys:
        value = content.get(key)
        if value not in (None, False, 0, 0.0, [], {}, ""):
            raise InputError(f"{place}: {what} is not held ('{key}')")
