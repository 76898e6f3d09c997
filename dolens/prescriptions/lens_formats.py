"""The formats of lens files: how each is recognised, read and written."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.files import decode_text, much_at_once, without_controls
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.writer import codev_of
from dolens.prescriptions.curved_object import curved_object
from dolens.prescriptions.diffoptics_text import (
    diffoptics_text_of,
    object_radius,
    prescription_from_diffoptics,
)
from dolens.prescriptions.json_lenses import json_of, read_json
from dolens.prescriptions.oslo.reader import read_oslo
from dolens.prescriptions.read_file import ReadPrescription
from dolens.prescriptions.unknown_content import require_text
from dolens.prescriptions.yaml_text import read_yaml, yaml_of
from dolens.prescriptions.zemax import encode_zemax
from dolens.prescriptions.zemax_reader import read_zemax
from dolens.prescriptions.zemax_writer import zemax_of

# A lens is text of some kilobytes; more is no lens.
MOST_BYTES = 64 * 2**20
_LOOKED_AT = 65536


@dataclass(frozen=True)
class LensFormat:
    """A `LensFormat` is one way to write a lens down.

    Attributes:
        name: in messages and tables.
        suffixes: of its files, in small letters; the first is the usual one.
        signs: one after the other, in text that is surely of this format, whatever the file's
            name; none where no text is.
        read: from decoded text and the file's name to its prescription.
        write: from a prescription and the file's name to bytes; None where it is only read.
    """

    name: str
    suffixes: tuple[str, ...]
    signs: tuple[re.Pattern[str], ...]
    read: Callable[[str, str], ReadPrescription]
    write: Callable[[Mapping[str, Any], str], bytes] | None


def _lines(*patterns: str) -> tuple[re.Pattern[str], ...]:
    """Return expressions for whole lines: they look at no line twice, however long it is."""
    return tuple(re.compile(rf"^{pattern}[ \t\r]*$", re.MULTILINE) for pattern in patterns)


def _is_of(text: str, signs: tuple[re.Pattern[str], ...]) -> bool:
    """Return whether text has the signs of a format, one after the other."""
    at = 0
    for sign in signs:
        found = sign.search(text, at)
        if found is None:
            return False
        at = found.end()
    return bool(signs)


def _read_diffoptics(text: str, where: str) -> ReadPrescription:
    prescription = prescription_from_diffoptics(text, where)
    radius = object_radius(text, where)
    return ReadPrescription(
        prescription, curved_object(prescription, {"radius": radius}, f"{where}: the object")
    )


# In the order in which content is looked at.
FORMATS: tuple[LensFormat, ...] = (
    LensFormat(
        "dolens YAML",
        (".yaml", ".yml"),
        _lines(r"surfaces:"),
        read_yaml,
        yaml_of,
    ),
    LensFormat(
        "Zemax",
        (".zmx",),
        _lines(r"SURF 0"),
        read_zemax,
        lambda prescription, where: encode_zemax(zemax_of(prescription, where)),
    ),
    LensFormat(
        "OSLO",
        (".len", ".osl"),
        _lines(r"[ \t]*(?i:LEN[ \t]+NEW)\b.*"),
        read_oslo,
        None,
    ),
    LensFormat(
        "CODE V",
        (".seq",),
        _lines(r"[ \t]*(?i:SO)[ \t]+[-+.\d].*", r"[ \t]*(?i:SI)\b.*"),
        read_codev,
        lambda prescription, where: codev_of(prescription, where).encode(),
    ),
    LensFormat("JSON", (".json",), (re.compile(r"\A\s*\{"),), read_json, json_of),
    # Of ray-optics; its JSON is found by its content.
    LensFormat("JSON", (".roa",), (), read_json, None),
    LensFormat(
        "dO text",
        (".txt",),
        (),
        _read_diffoptics,
        lambda prescription, where: diffoptics_text_of(prescription, where).encode(),
    ),
)
SUFFIXES = tuple(suffix for each in FORMATS for suffix in each.suffixes)
WRITTEN_SUFFIXES = tuple(suffix for each in FORMATS if each.write for suffix in each.suffixes)


def read_lens(data: bytes, path: str | Path) -> ReadPrescription:
    """Read the content of a lens file in any format.

    What the text says counts before the file's name: a file of Zemax named `.txt` is one of Zemax.

    Args:
        data: what the file holds.
        path: its name, for messages, and for formats that do not say what they are.

    Raises:
        InputError: the content is of no known format, or not valid; one line that names the file.
    """
    where, suffix = str(path), Path(path).suffix.lower()
    if len(data) > MOST_BYTES:
        raise InputError(f"{where}: is larger than {MOST_BYTES // 2**20} MB, and no lens")
    require_text(data, where)
    named = next((each for each in FORMATS if suffix in each.suffixes), None)
    if named is not None and named.name == "dolens YAML":
        # Anything may stand in YAML's texts, and its loader says best what is wrong with it.
        return named.read(_utf_8(data, where, "YAML"), where)
    text = decode_text(data, where).removeprefix("\ufeff")
    begin = text[:_LOOKED_AT]
    by_content = next((each for each in FORMATS if _is_of(begin, each.signs)), None)
    chosen = by_content or named
    if chosen is None:
        raise InputError(
            f"{where}: is no lens file that is known here; lens files end in {', '.join(SUFFIXES)}"
        )
    if chosen.name == "dO text":
        text = _utf_8(data, where, "text")
    with much_at_once():
        return chosen.read(text, where)


def encode_lens(prescription: Mapping[str, Any], path: str | Path) -> bytes:
    """Return what a lens file of that name would hold; nothing is written.

    Raises:
        InputError: the suffix names no format that is written, or the format cannot hold the lens.
    """
    suffix = Path(path).suffix.lower()
    chosen = next((each for each in FORMATS if suffix in each.suffixes), None)
    if chosen is None or chosen.write is None:
        why = f"{chosen.name} is read, not written" if chosen else "unknown suffix"
        if suffix in (".step", ".stp"):
            why = "solids are written by 'dolens export LENS --only step'"
        raise InputError(f"{path}: {why}; lens files are written as {', '.join(WRITTEN_SUFFIXES)}")
    if chosen.name not in ("dolens YAML", "JSON"):
        _require_plain_lines(prescription, str(path))
    try:
        return chosen.write(prescription, str(path))
    except UnicodeEncodeError as error:
        half = error.object[error.start : error.end]
        raise InputError(f"{path}: no text file holds half of a surrogate pair, {half}") from None


def _require_plain_lines(node: object, where: str, key: str = "") -> None:
    """Refuse texts that would be other lines of a file of lines, or that a terminal would obey."""
    if isinstance(node, Mapping):
        for name, entry in node.items():
            place = f"{where}: surface {name}" if key == "surfaces" else where
            _require_plain_lines(entry, place, str(name))
    elif isinstance(node, str):
        for line in node.splitlines() if key == "source" else (node,):
            if line != without_controls(line):
                raise InputError(
                    f"{where}: '{key}' has control characters, which such a file does not hold: "
                    f"{line!r}"
                )


def _utf_8(data: bytes, where: str, kind: str) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not valid {kind} ({error})") from None
