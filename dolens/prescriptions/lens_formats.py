"""The formats of lens files: how each is recognised, read and written.

A file that is no lens file is named for what it is in one line, by its first bytes.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from dolens.errors import InputError
from dolens.files import decode_text, much_at_once, without_controls
from dolens.prescriptions.other_programs import ReadPrescription, curved_object
from dolens.prescriptions.plain_values import (
    Watched,
    json_content,
    json_of,
    passed_over,
    read_yaml,
    yaml_of,
)

# A lens is text of some kilobytes; more is no lens.
MOST_BYTES = 64 * 2**20
_LOOKED_AT = 65536

_JsonReader = Callable[[dict[str, Any], str], ReadPrescription]
_UTF_32 = (b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff")
_UNPACK = "unpack it, and give the lens file that it holds"
# First bytes → what the file is, and what to do.
_BEGINNINGS: tuple[tuple[bytes, str], ...] = (
    (b"PK\x03\x04", f"is a .zip archive; {_UNPACK}"),
    (b"\x1f\x8b", f"is compressed (gzip); {_UNPACK}"),
    (b"7z\xbc\xaf", f"is a .7z archive; {_UNPACK}"),
    (b"Rar!", f"is a .rar archive; {_UNPACK}"),
    (b"\xfd7zXZ", f"is compressed (xz); {_UNPACK}"),
    (b"BZh", f"is compressed (bzip2); {_UNPACK}"),
    (b"ZoS", "is OpticStudio's binary form of a lens (.zos); save it as .zmx there"),
    (b"%PDF", "is a PDF document, no lens file"),
    (b"\x89PNG", "is a PNG picture, no lens file"),
    (b"\xff\xd8\xff", "is a JPEG picture, no lens file"),
    (b"GIF8", "is a GIF picture, no lens file"),
    (b"\xd0\xcf\x11\xe0", "is a document of Microsoft Office, no lens file"),
    (b"\x80\x02", "is a Python pickle, which is never read; save the lens as text"),
)
# OpticStudio's archives begin with their version.
_ZAR = (b"\xea\x00\x00\x00", b"\xec\x03\x00\x00")
# CODE V's own files begin with these bytes.
_CODE_V = b"]\x00\x00\x00"
_CONTROL = frozenset(range(32)) - {9, 10, 11, 12, 13, 26, 27}
_BEGIN = 4096


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


def _later(name: str) -> Callable[..., Any]:
    """Return a function of the package `prescriptions` that is imported when it is called: most
    programs load no file of others.
    """

    def call(*arguments: Any) -> Any:
        return resolve_name(f"dolens.prescriptions.{name}")(*arguments)

    return call


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
    from dolens.prescriptions.diffoptics_text import object_radius, prescription_from_diffoptics

    prescription = prescription_from_diffoptics(text, where)
    radius = object_radius(text, where)
    return ReadPrescription(
        prescription, curved_object(prescription, {"radius": radius}, f"{where}: the object")
    )


def _is_deeplens(content: dict[str, Any]) -> bool:
    surfaces = content.get("surfaces")
    if not isinstance(surfaces, list) or not surfaces or not isinstance(surfaces[0], dict):
        return False
    return "type" in surfaces[0] and any("d_next" in s for s in surfaces if isinstance(s, dict))


# Programs that write JSON, as the keys of their files tell.
_JSON_READERS: tuple[tuple[Callable[[dict[str, Any]], bool], _JsonReader], ...] = (
    (lambda content: "surface_group" in content, _later("optiland_json:read_optiland")),
    (_is_deeplens, _later("deeplens_json:read_deeplens")),
    (lambda content: "optical_model" in content, _later("ray_optics_json:read_ray_optics")),
)


def read_json(text: str, where: str) -> ReadPrescription:
    """Read a lens in JSON: dolens's own prescription, or a file of another program.

    Raises:
        InputError: it is not valid JSON, a key is given twice, or no known program wrote it.
    """
    content = json_content(text, where)
    if isinstance(content.get("surfaces"), dict):
        return ReadPrescription(content, [])
    for holds, read in _JSON_READERS:
        if holds(content):
            watched = Watched(content)
            prescription, more = read(watched, where)
            return ReadPrescription(prescription, [*more, *passed_over(watched)])
    keys = ", ".join(list(content)[:5]) or "none"
    raise InputError(
        f"{where}: no program that is known here writes lenses with the keys {keys} (allowed: "
        "prescriptions of dolens, and files of Optiland, DeepLens and ray-optics)"
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
        _later("zemax.reader:read_zemax"),
        lambda *given: _later("zemax.file:encode_zemax")(_later("zemax.writer:zemax_of")(*given)),
    ),
    LensFormat(
        "OSLO",
        (".len", ".osl"),
        _lines(r"[ \t]*(?i:LEN[ \t]+NEW)\b.*"),
        _later("oslo:read_oslo"),
        None,
    ),
    LensFormat(
        "CODE V",
        (".seq",),
        _lines(r"[ \t]*(?i:SO)[ \t]+[-+.\d].*", r"[ \t]*(?i:SI)\b.*"),
        _later("codev.reader:read_codev"),
        lambda *given: _later("codev.writer:codev_of")(*given).encode(),
    ),
    LensFormat("JSON", (".json",), (re.compile(r"\A\s*\{"),), read_json, json_of),
    # Of ray-optics; its JSON is found by its content.
    LensFormat("JSON", (".roa",), (), read_json, None),
    LensFormat(
        "dO text",
        (".txt",),
        (),
        _read_diffoptics,
        lambda *given: _later("diffoptics_text:diffoptics_text_of")(*given).encode(),
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


def require_text(data: bytes, where: str) -> None:
    """Raise `InputError` where a file's content is no text of a lens; one line says what it is.

    Args:
        data: what the file holds.
        where: its name.

    Raises:
        InputError: the file is empty, an archive, a picture, a page of a website, or binary.
    """
    if not data.strip(b"\0 \t\r\n\x1a\xef\xbb\xbf\xff\xfe"):
        raise InputError(f"{where}: is empty")
    if data.startswith(_UTF_32):
        raise InputError(f"{where}: is text in UTF-32; save it as UTF-8 or UTF-16")
    for beginning, what in _BEGINNINGS:
        if data.startswith(beginning):
            raise InputError(f"{where}: {what}")
    if data.startswith(_ZAR) or (where.lower().endswith(".zar") and b"\0" in data[:8]):
        raise InputError(
            f"{where}: is an archive of OpticStudio (.zar); unpack it there (File, Load Archive) "
            "or with unzar of the package zmxtools, and give the .zmx file that it holds"
        )
    if data.startswith(_CODE_V):
        raise InputError(
            f"{where}: is CODE V's binary form of a lens; save it as a sequence file (.seq) in "
            "CODE V (WRL, or File, Export)"
        )
    begin = data[:_BEGIN].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if begin.startswith((b"<!doctype html", b"<html")):
        raise InputError(
            f"{where}: is a page of a website (HTML), no lens file; it may tell why a download "
            "failed"
        )
    if begin.startswith((b"<?xml", b"<svg")):
        raise InputError(f"{where}: is XML, no lens file that is known here")
    if _is_binary(data[:_BEGIN]):
        raise InputError(f"{where}: is binary, no text of a lens")


def _is_binary(data: bytes) -> bool:
    """Return whether bytes are no text in UTF-8, UTF-16 or Latin-1."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return False
    # UTF-16 without a mark has a zero in every other byte of plain letters.
    for text, zeros in ((data[0::2], data[1::2]), (data[1::2], data[0::2])):
        if zeros and zeros.count(0) > 0.9 * len(zeros) and not _CONTROL & set(text):
            return False
    return bool(_CONTROL & set(data))
