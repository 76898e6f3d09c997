"""Files that a user or a stranger names are read and decoded, whatever system wrote them.

Paths that they name are looked at before anything is done with them.
"""

import codecs
import gc
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from unicodedata import category

from dolens.errors import InputError

# What is no file of bytes: reading it would wait for another program, or never end.
_OTHERS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
# Unicode's categories: control characters, halves of surrogate pairs, ends of lines and paragraphs.
_CONTROLS = ("Cc", "Cs", "Zl", "Zp")
# Of a file or a folder, in bytes.
_LONGEST_NAME = 255
_AT_ONCE = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def read_file(path: str | Path, most_bytes: int, what: str = "lens file") -> bytes:
    """Return what a file holds; what is no file, or too large, is refused without being read.

    Args:
        path: the file, or a link to it.
        most_bytes: the largest size that is read.
        what: what the file is to be, for messages.

    Raises:
        InputError: it is a folder, a pipe or a device, it is missing, too large or cannot be read,
            or the path is none; one line that names it.
    """
    try:
        _require_file(os.stat(path), path, what)
        # It may be another one by now: what was opened is looked at again, and opens at once.
        with os.fdopen(os.open(path, os.O_RDONLY | _AT_ONCE), "rb") as file:
            _require_file(os.fstat(file.fileno()), path, what)
            data = file.read(most_bytes + 1)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError:  # a zero byte, or half of a surrogate pair
        raise InputError(f"{path}: is no path of a file") from None
    if len(data) > most_bytes:
        raise InputError(f"{path}: is larger than {most_bytes // 2**20} MB, and no {what}")
    return data


@contextmanager
def much_at_once() -> Iterator[None]:
    """Let Python not look for circles among what is read, over all of it again and again.

    There are none in the values of a file, and with many of them nothing else would take as long.
    """
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def resolved_path(path: str | Path) -> Path:
    """Return a path from the root on, with links followed and `~` as the home; nothing needs to be
    there.

    Raises:
        InputError: no file system has such a path, or the links in it lead in a circle; one line
            that names it.
    """
    try:
        found = Path(path).expanduser().resolve()
        if any(len(os.fsencode(part)) > _LONGEST_NAME for part in found.parts):
            raise InputError(f"{path}: is no path (File name too long)")
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            found.stat()
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: is no path ({error.strerror or error})") from None
    except (ValueError, RuntimeError):  # a zero byte, half of a surrogate pair; a home of nobody
        raise InputError(f"{path}: is no path of a file") from None
    return found


def check_written(path: Path | None, option: str, folder: bool = False) -> None:
    """Refuse a path that nothing can be written to, before the work whose result goes there.

    Args:
        path: of a file, which may be there, or of a folder; None is taken as it is.
        option: that names it; the message begins with it.
        folder: whether it is one.

    Raises:
        InputError: it is a folder, a pipe or a device in the place of a file, or the reverse; a
            folder of it is none; or the system says no.
    """
    if path is None:
        return
    try:
        state = resolved_path(path).stat()
        if folder and not stat.S_ISDIR(state.st_mode):
            raise InputError(f"{path}: is no folder")
        if not folder:
            _require_file(state, path, "file to write to")
        if not os.access(path, os.W_OK):
            raise InputError(f"{path}: cannot be written (Permission denied)")
    except FileNotFoundError:
        check_written(resolved_path(path).parent, option, folder=True)
    except InputError as error:
        raise InputError(f"{option}: {error}") from None
    except OSError as error:
        raise InputError(f"{option}: {path}: cannot be written ({error.strerror})") from None


def _require_file(state: os.stat_result, path: str | Path, what: str) -> None:
    for holds, kind in _OTHERS:
        if holds(state.st_mode):
            raise InputError(f"{path}: is {kind}, no {what}")


def without_controls(text: str) -> str:
    """Return a text with a blank for each line end and control character, and for what has no
    bytes.
    """
    return "".join(" " if category(letter) in _CONTROLS else letter for letter in text)


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
