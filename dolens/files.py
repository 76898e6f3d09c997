"""Files: what a user names is read and decoded, results are written whole or not at all, and what
can be made anew is kept in a cache; versions and configuration come with the installation.

Paths that files name are looked at before anything is done with them.
"""

import codecs
import gc
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
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
    Modules and what a compiler makes have them, and mostly stay.
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


# Of what is being written, or was when its process was killed.
UNFINISHED = ".part"


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a path to write to, and put what was written in its place when the block ends.

    A full disk, an error in the block or the end of the process leaves the file that was there
    before.  What was written is on the disk, and no longer only on its way there, before it takes
    the place of the other.

    Args:
        path: of the file; its folder exists.

    Yields:
        The path to write to, in the same folder, since only there a file is replaced at once.

    Raises:
        OSError: the file cannot be written, as on a full disk.
    """
    aside = path.with_name(path.name + UNFINISHED)
    try:
        yield aside
        with aside.open("rb+") as file:
            os.fsync(file.fileno())
        aside.replace(path)
    except BaseException as error:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        # What the user asked for; an error as of a full disk, amid writing, has no name at all.
        if isinstance(error, OSError) and error.filename in (None, str(aside)):
            error.filename, error.filename2 = str(path), None
        raise


# Days after which what nothing was added to is deleted.
_KEPT_DAYS = 90.0


def user_cache_folder() -> Path:
    """Return `dolens` in the user's cache folder.

    That is XDG_CACHE_HOME or ~/.cache on Linux, ~/Library/Caches on macOS, LOCALAPPDATA on Windows.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if sys.platform == "win32":
        of_user = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        of_user = Path.home() / "Library" / "Caches"
    else:
        # The convention says that a relative path is to be passed over.
        of_user = Path(os.environ.get("XDG_CACHE_HOME", ""))
        of_user = of_user if of_user.is_absolute() else Path.home() / ".cache"
    return Path(of_user) / "dolens"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that this user alone reads, and other processes see whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def delete_old(folder: Path) -> None:
    """Delete the files and folders in a folder that nobody has changed for months."""
    oldest = time.time() - _KEPT_DAYS * 86400.0
    for entry in folder.iterdir():
        if entry.stat().st_mtime >= oldest:
            continue
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def packaged_configuration() -> Path:
    """Return the folder of the configuration that comes with dolens.

    It is `dolens/conf`, which in a checkout of the repository is a link to `conf`.  Its subfolders
    are the groups: `lens`, `experiment`, `network`, …

    Raises:
        InputError: the folder is not there: the installation is not complete.
    """
    folder = (Path(__file__).resolve().parent / "conf").resolve()
    if not (folder / "train.yaml").is_file():
        raise InputError(
            f"the configuration of dolens is missing: no train.yaml in {folder}; "
            "install dolens again"
        )
    return folder


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
