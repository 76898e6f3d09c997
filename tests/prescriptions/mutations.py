"""Lens files that are damaged or hostile: bits, lines, numbers, keys and whole trees are changed.

A number (the seed) gives the same mutated file back.
"""

import codecs
import contextlib
import json
import random
import re
from collections.abc import Callable, Iterable
from typing import Any

import yaml

# Texts that stand where a number or a word is expected.
HOSTILE = (
    "nan", "-nan", "inf", "-inf", ".inf", "-.inf", ".nan", "Infinity", "NaN", "1e308", "-1e308",
    "1e309", "1e-320", "1e-400", "4.9e-324", "1e999999999999", "1E+4000", "9" * 5000, "1." * 400,
    "0." + "0" * 4000 + "1", "0b", "0b1", "0x", "0x1F", "0o17", "017", "09", "1_000", "_1",
    "1__0", "1:60", "190:20:30", "2001-13-01", "2001-12-14", "2001-12-14t21:59:43.10-05:00",
    "9999999-1-1", "yes", "no", "on", "off", "true", "false", "null", "~", "", "''", '""', "=",
    "<<", "-", ".", "٣", "１２", "½", "−5", "1,5", "1e", "e5", "+", "--1", "1.5.2", "1/0", "0/0",
    "1.5/0", "nan/nan", "\0", "\x07", "\x1b[31m", "\x7f", "\x85", "\u2028", "\u202e", "\ufeff",
    "\ud7ff", "\uffff", "0", "-0", "-0.0", "1", "-1", "2", "1e6", "1e5", "1000000", "-1000000",
    "2147483648", "1e20", "18446744073709551616", "1e154", "1e200", "-1e200", "1e-200", "1e-15",
    "180", "90", "-90", "auto", "air", "mirror", "occluder", "N-BK7", "SCHOTT:", ":N-BK7",
    "1.5168/64.17/1/2", "MIRROR", "../../../etc/passwd", "/dev/zero", "%s%n", "{0}",
    "${oc.env:HOME}", "__class__", "a" * 3000, "a1000000", "a4.5", "a-4", "a５", "x999y999",
    "x1000000", "z1000000", "z0", "x", "y", "xy", "x0y0",
)  # fmt: skip
VALUES = (
    None, True, False, 0, -1, 1, 10**6, 10**400, -(10**400), 10**5000, 0.0, -0.0, 1e-320, 1e308,
    -1e308, 1e200, 1e-200, 1.5, 12.0, float("nan"), float("inf"), float("-inf"), "", "1", "x", [],
    {}, [1], [[]], [None], [[1, 2], [3]], {"": 1}, {"x": {}}, [0.0] * 1000, [[0.0] * 40] * 40,
    [1, "a"], "plane", "sphere", "conic", "even_asphere", "odd_asphere", "xy_polynomial",
    "b_spline", "q_con", "biconic", "toroid", "grid_sag", "zernike_fringe", "q_bfs",
    "coordinate_break", "paraxial_lens", "mirror", "air", "auto", "1.5168/64.17", "infinity",
    "angles", "heights", "do", "paper", "-",
)  # fmt: skip
KEYS = (
    "a1000000", "a4", "a6", "a16", "a400", "a05", "a-4", "x999y999", "x1000000", "y2", "x2y",
    "z1000000", "z4", "z37", "z231", "b1000000", "b2", "radius", "curvature", "conic",
    "thickness", "material", "semi_diameter", "aperture", "obscuration", "clips", "phase", "type",
    "elements", "states", "stop", "sensor", "fields", "f_number", "wavelengths", "temperature",
    "pressure", "object_distance", "published", "object_material", "telecentric_object",
    "object_na", "real_pupil", "note", "tilt_x", "decenter_y", "coefficients", "norm_radius",
    "order", "focal_length", "coating", "thermal_expansion", "1", "2", "0", "-1", "01", "1.0", "٣",
    "", " ", "\x1b", "k" * 2000, "__class__", "temperature_radians",
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?")
_WORD = re.compile(rb"[^\s,:\[\]{}\"']+")
_BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{this}: &{this} [{', '.join([f'*{last}'] * 9)}]\n"
    for last, this in zip("abcdefgh", "bcdefghi", strict=True)
)
# Lines put into a YAML file.
_SNIPPETS = (
    _BOMB, "name: &n [*n]\n", "name: *missing\n", "sensor: &s {distance: *s}\n",
    "<<: {stop: 1}\n", "<<: &m {<<: *m}\n", "<<: 5\n", "<<: [1, 2]\n",
    "name: !!python/object/apply:os.system [id]\n", "name: !!python/name:os.system\n",
    "stop: !!int x\n", "stop: !!float x\n", "stop: !!binary '###'\n", "stop: !!timestamp x\n",
    "stop: !!bool x\n", "stop: !!set {a, b}\n", "name: !!omap [1]\n", "name: !!pairs x\n",
    "stop: !!null x\n", "name: !foo x\n", "? [1, 2]\n: 3\n", "? {a: 1}\n: 3\n", "--- \n", "...\n",
    "%YAML 9.9\n---\n", "%TAG ! x\n---\n", "name: |\n", "name: >\n  x\n", "\t\tname: x\n",
    "name: " + "[" * 3000 + "\n", "name: " + "{a: " * 3000 + "\n",
    "name: " + "[" * 300 + "]" * 300 + "\n", "name: '" + "x" * 20000 + "'\n",
    'name: "\\x00\\u2028\\U0001F600\\e"\n', "2001-01-01: x\n", "1.5: x\n", "null: x\n",
    "true: x\n", ".nan: x\n", "surfaces:\n", "sensor: {distance: .nan}\n", "elements: 5\n",
)  # fmt: skip


def mutated(data: bytes, suffix: str, seed: int) -> bytes:
    """Return a lens file after one to four random changes.

    Args:
        data: the file's content.
        suffix: its kind, such as `.yaml`.
        seed: any integer.
    """
    rng = random.Random(seed)
    changes: list[Callable[[bytes, random.Random], bytes]] = [*_BYTES, *_TEXTS, *_TEXTS]
    if suffix in (".yaml", ".json"):
        tree = _yaml_tree if suffix == ".yaml" else _json_tree
        changes += [tree] * (2 * len(changes))
    if suffix == ".yaml":
        changes += [_snippet] * 4
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        data = rng.choice(changes)(data, rng)
    return data


def _flip_bits(data: bytes, rng: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        if found:
            found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _cut(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.randrange(1, 40) :]


def _insert_bytes(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    more = rng.choice((bytes([rng.randrange(256)]), b"\0", b"\xff\xfe", b"\x1a", rng.randbytes(8)))
    return data[:at] + more + data[at:]


def _other_encoding(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("latin-1")
    ways: tuple[Callable[[], bytes], ...] = (
        lambda: text.encode("utf-16"),
        lambda: text.encode("utf-16-le"),
        lambda: text.encode("utf-16-be"),
        lambda: codecs.BOM_UTF8 + data,
        lambda: codecs.BOM_UTF8 + codecs.BOM_UTF8 + data,
        lambda: codecs.BOM_UTF16_LE + data,
        lambda: data.replace(b"\n", b"\r\n"),
        lambda: data.replace(b"\n", b"\r"),
        lambda: data.replace(b" ", "\xa0".encode()),
        lambda: data.replace(b"e", b"\xe9"),
        lambda: text.replace("\n", "\x85").encode(),
        lambda: text.replace("\n", "\u2028").encode(),
    )
    return rng.choice(ways)()


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.randrange(6)
    if way == 0:
        lines.insert(at, lines[other])
    elif way == 1:
        del lines[at]
    elif way == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif way == 3:
        lines[at:at] = [lines[at]] * rng.choice((2, 30, 300))
    elif way == 4:
        del lines[at : at + rng.randrange(1, 10)]
    else:
        lines[at] = rng.choice(HOSTILE).encode(errors="replace") + b" " + lines[at]
    return b"".join(lines)


def _replace(pattern: re.Pattern[bytes]) -> Callable[[bytes, random.Random], bytes]:
    """Return the change that puts a hostile text in the place of something."""

    def change(data: bytes, rng: random.Random) -> bytes:
        places = [match.span() for match in pattern.finditer(data)]
        for begin, end in sorted(rng.sample(places, min(rng.choice((1, 1, 1, 2, 5)), len(places))))[
            ::-1
        ]:
            hostile = rng.choice(HOSTILE).encode(errors="replace")
            data = data[:begin] + hostile + data[end:]
        return data

    return change


def _scale(data: bytes, rng: random.Random) -> bytes:
    places = [match.span() for match in _NUMBER.finditer(data)]
    if not places:
        return data
    begin, end = rng.choice(places)
    try:
        value = float(data[begin:end])
    except ValueError:
        return data
    value *= rng.choice((-1.0, 0.0, 10.0, -10.0, 1e-3, 1e3, 1e10, 1e-10, 1e100, 1e300, 1.0 + 1e-15))
    return data[:begin] + repr(value).encode() + data[end:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    part = data[at : at + rng.randrange(1, 200)]
    return data[:at] + part * rng.choice((2, 2, 10, 100)) + data[at:]


def _snippet(data: bytes, rng: random.Random) -> bytes:
    more = rng.choice(_SNIPPETS).encode(errors="surrogatepass")
    lines = data.splitlines(keepends=True)
    at = rng.choice((0, len(lines), rng.randrange(len(lines) + 1)))
    return b"".join([*lines[:at], more, *lines[at:]])


def _yaml_tree(data: bytes, rng: random.Random) -> bytes:
    try:
        tree = yaml.load(data.decode(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except Exception:  # what damaged YAML raises here is of no interest
        return data
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    tree = _changed_tree(tree, rng)
    try:
        style = {"sort_keys": False, "default_flow_style": None, "allow_unicode": True}
        text = yaml.dump(tree, Dumper=dumper, **style)
    except (yaml.YAMLError, ValueError):
        return data
    return text.encode(errors="surrogatepass")


def _json_tree(data: bytes, rng: random.Random) -> bytes:
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return data
    try:
        return json.dumps(_changed_tree(tree, rng)).encode()
    except ValueError:
        return data


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Return every (mapping or list, key) of a tree."""
    found, waiting = [], [tree]
    while waiting and len(found) < 5000:
        node = waiting.pop()
        keys: Iterable[Any] = node if isinstance(node, dict) else ()
        if isinstance(node, list):
            keys = range(len(node))
        found += [(node, key) for key in keys]
        waiting += [node[key] for key in keys]
    return found


def _changed_tree(tree: Any, rng: random.Random) -> Any:
    places = _places(tree)
    if not places:
        return rng.choice(VALUES)
    for _ in range(rng.choice((1, 1, 2, 3))):
        node, key = rng.choice(places)
        other, there = rng.choice(places)
        try:
            _change(node, key, other, there, rng)
        except (KeyError, IndexError, ValueError):
            # An earlier change took it away, or an alias holds itself.
            continue
    return tree


def _change(node: Any, key: Any, other: Any, there: Any, rng: random.Random) -> None:
    way = rng.randrange(9)
    value = node[key]
    if way <= 2:
        node[key] = rng.choice(VALUES)
    elif way == 3:
        del node[key]
    elif way == 4 and isinstance(node, dict):
        node[rng.choice((*KEYS, *HOSTILE, None, 1.5, 7))] = node.pop(key)
    elif way == 5 and isinstance(node, dict):
        node[rng.choice((*KEYS, *KEYS, None, 1.5, 7))] = rng.choice((*VALUES, value))
    elif way == 6:
        text = json.dumps(other[there])
        node[key] = json.loads(text) if len(text) < 20000 else None
    elif way == 7 and isinstance(value, int | float):
        with contextlib.suppress(OverflowError):  # an integer of hundreds of digits
            node[key] = value * rng.choice((-1, 0, 10, 1e-3, 1e3, 1e10, 1e100, 1.0 + 1e-15, 0.5))
    elif isinstance(value, list):
        node[key] = value * rng.choice((2, 3, 50)) if value else [1]
    else:
        node[key] = rng.choice((str(value), [value], {"x": value}, rng.choice(HOSTILE)))


_BYTES = (_flip_bits, _truncate, _cut, _insert_bytes, _other_encoding, _repeat)
_TEXTS = (_lines, _replace(_NUMBER), _replace(_NUMBER), _replace(_WORD), _scale)
