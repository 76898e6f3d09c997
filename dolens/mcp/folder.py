"""The one folder that a program may read from and write to.

A path is followed part by part, each opened in the folder before it without following links, so
that nothing outside is reached, whatever becomes of the folder meanwhile.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from dolens.errors import InputError
from dolens.files import UNFINISHED, resolved_path

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_PARTS = 8
_ALLOWED = "a path within the folder, without '..', from no root"
# Of a list.
_MOST_FILES = 200


class Folder:
    """A folder, and the files in it and below.

    Args:
        path: of the folder; it may be a link.

    Raises:
        InputError: there is no such folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = resolved_path(path)
        if not self.path.is_dir():
            raise InputError(f"{path}: no such folder")
        self._written: set[str] = set()

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return what a file of the folder holds.

        Args:
            name: its path from the folder on.
            most_bytes: the largest size that is read.

        Raises:
            InputError: the path leads elsewhere, or is that of no file or a link; the file is
                larger, or cannot be read.
        """
        with self._opened(name) as (folder, last):
            handle = os.open(last, _READ, dir_fd=folder)
            try:
                if not stat.S_ISREG(os.fstat(handle).st_mode):
                    raise InputError(f"{name}: is no file")
                with os.fdopen(handle, "rb", closefd=False) as file:
                    data = file.read(most_bytes + 1)
            finally:
                os.close(handle)
        if len(data) > most_bytes:
            raise InputError(f"{name}: is larger than {most_bytes // 2**20} MB")
        return data

    def check_writable(self, name: str, overwrite: bool = False) -> None:
        """Refuse a path that `write` would refuse, before the work whose result goes there."""
        with self._opened(name) as (folder, last), suppress(FileNotFoundError):
            found = os.stat(last, dir_fd=folder, follow_symlinks=False)
            if not stat.S_ISREG(found.st_mode):
                raise InputError(f"{name}: is no file")
            if not overwrite and self._key(name) not in self._written:
                raise InputError(
                    f"{name}: exists already, and was not written in this session; "
                    "overwrite=true writes over it"
                )

    def write(self, name: str, data: bytes, overwrite: bool = False) -> None:
        """Write a whole file or none.

        Args:
            name: its path from the folder on; folders in it are there already.
            data: what it is to hold.
            overwrite: whether it may replace a file that was not written in this session.

        Raises:
            InputError: as `read` and `check_writable` say.
        """
        self.check_writable(name, overwrite)
        with self._opened(name) as (folder, last):
            aside = last + UNFINISHED
            with suppress(FileNotFoundError):
                os.unlink(aside, dir_fd=folder)
            try:
                with os.fdopen(os.open(aside, _WRITE, 0o644, dir_fd=folder), "wb") as file:
                    file.write(data)
                os.replace(aside, last, src_dir_fd=folder, dst_dir_fd=folder)
            except BaseException:
                with suppress(FileNotFoundError):
                    os.unlink(aside, dir_fd=folder)
                raise
        self._written.add(self._key(name))

    def files(self, suffixes: tuple[str, ...]) -> list[str]:
        """Return the paths of files with these suffixes, without links; 200 at most."""
        found = []
        for at, folders, names in os.walk(self.path):
            inside = Path(at).relative_to(self.path)
            folders[:] = sorted(f for f in folders if not f.startswith("."))
            if len(inside.parts) >= _PARTS - 1:
                folders.clear()
            for name in sorted(names):
                path = inside / name
                if path.suffix.lower() in suffixes and not (self.path / path).is_symlink():
                    found.append(path.as_posix())
                if len(found) == _MOST_FILES:
                    return found
        return found

    @staticmethod
    def _key(name: str) -> str:
        return PurePosixPath(name).as_posix()

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[int, str]]:
        """Give the open folder of a path and the path's last part; say what the system refuses in
        one line.
        """
        path = PurePosixPath(name)
        parts = path.parts
        if not parts or path.is_absolute() or ".." in parts or "~" in name[:1] or "\0" in name:
            raise InputError(f"{name or 'the path'}: leads out of the folder; allowed: {_ALLOWED}")
        if len(parts) > _PARTS:
            raise InputError(f"{name}: more than {_PARTS} folders deep")
        folder = -1
        try:
            folder = os.open(self.path, _FOLDER)
            for part in parts[:-1]:
                inner = os.open(part, _FOLDER, dir_fd=folder)
                os.close(folder)
                folder = inner
            yield folder, parts[-1]
        except OSError as error:
            raise InputError(f"{name}: {_reason(folder, parts[-1], error)}") from None
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{name}: is no path of a file") from None
        finally:
            if folder >= 0:
                os.close(folder)


def _reason(folder: int, last: str, error: OSError) -> str:
    """Return why a path was refused: a link is named as such."""
    if error.filename is not None and folder >= 0:
        with suppress(OSError, ValueError):
            found = os.stat(error.filename, dir_fd=folder, follow_symlinks=False)
            if stat.S_ISLNK(found.st_mode):
                return "is a link, or lies behind one; allowed: " + _ALLOWED
    return f"cannot be opened ({error.strerror or error})"
