"""A file that is no lens file is named for what it is in one line, by its first bytes."""

from dolens.errors import InputError

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
_LOOKED_AT = 4096


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
    begin = data[:_LOOKED_AT].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if begin.startswith((b"<!doctype html", b"<html")):
        raise InputError(
            f"{where}: is a page of a website (HTML), no lens file; it may tell why a download "
            "failed"
        )
    if begin.startswith((b"<?xml", b"<svg")):
        raise InputError(f"{where}: is XML, no lens file that is known here")
    if _is_binary(data[:_LOOKED_AT]):
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
