"""Text files of other programs are decoded, whatever program and system wrote them."""

import codecs

from dolens.errors import InputError


def decode_text(data: bytes, where: str) -> str:
    """Decode a text file: UTF-16 or UTF-8, with a byte order mark or without, or Latin-1.

    Args:
        data: what the file holds.
        where: its name, for messages.

    Raises:
        InputError: the file is no text.
    """
    encoding = "utf-8"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif data.startswith(codecs.BOM_UTF8):
        encoding = "utf-8-sig"
    elif data[1:2] == b"\0":  # the first letter, in 16 bits
        encoding = "utf-16-le"
    elif data[:1] == b"\0":
        encoding = "utf-16-be"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            raise InputError(f"{where}: is not valid {encoding.upper()} text") from None
        text = data.decode("latin-1")
    if "\0" in text:
        raise InputError(f"{where}: is no text (allowed: UTF-16, UTF-8 or Latin-1)")
    return text
