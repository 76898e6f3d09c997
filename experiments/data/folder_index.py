"""The photographs under a folder are listed, and what is known of their headers is kept.

A file in the user's cache folder holds the names and what was found of the headers: arrays of
numbers and text; nothing in it is executed.  A second start opens no photograph that was sound.
"""

import hashlib
import io
import json
import logging
import os
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from dolens.errors import InputError
from dolens.files import delete_old, user_cache_folder, write_whole
from dolens.sensor.pictures import probe_picture
from dolens.tasks import stage

_log = logging.getLogger(__name__)

# As names of files that are no UTF-8 reach Python.
_ENCODING = ("utf-8", "surrogateescape")


class PackedNames(Sequence[str]):
    """`PackedNames` holds names in one array of bytes.

    A million strings are a million objects, whose counts of references every look at them changes:
    in worker processes, which share memory until it is written to, a list of them grows.  An array
    does not.

    Args:
        text: the names as UTF-8, uint8, each followed by a byte of 0.
    """

    def __init__(self, text: np.ndarray) -> None:
        self.text = text
        self._ends = np.flatnonzero(text == 0)

    @classmethod
    def of(cls, names: Sequence[str]) -> "PackedNames":
        """Pack names, none of which holds a character of code 0."""
        text = "".join(f"{name}\0" for name in names).encode(*_ENCODING)
        return cls(np.frombuffer(text, dtype=np.uint8))

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, number: int) -> str:  # type: ignore[override]
        """Return a name."""
        begin = 0 if number == 0 else int(self._ends[number - 1]) + 1
        return self.text[begin : int(self._ends[number])].tobytes().decode(*_ENCODING)

    def __iter__(self) -> Iterator[str]:
        """Yield all names, faster than one by one."""
        return iter(self.text.tobytes().decode(*_ENCODING).split("\0")[:-1])

    def encoded(self, numbers: Iterable[int]) -> Iterator[bytes]:
        """Yield some names as UTF-8."""
        text, ends = self.text.tobytes(), self._ends.tolist()
        for number in numbers:
            yield text[ends[number - 1] + 1 if number else 0 : ends[number]]


UNSEEN, SOUND, REFUSED = 0, 1, 2
"""What is known of a file's header."""


@dataclass(frozen=True)
class FolderIndex:
    """A `FolderIndex` lists the photographs under a folder, in the order of their paths.

    Attributes:
        folder: all of them lie below it.
        names: of the files, below the folder.
        header: UNSEEN, SOUND or REFUSED, uint8.
        size: of the file when its header was read, bytes, int64.
        modified: when it had last been written to then, ns, int64.
    """

    folder: Path
    names: PackedNames
    header: np.ndarray
    size: np.ndarray
    modified: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def path(self, number: int) -> Path:
        """Return the path of a file."""
        return self.folder / self.names[number]

    def recorded(self, number: int) -> tuple[int, int] | None:
        """Return (bytes, time of the last change in ns) of a file when its header was read; None
        where no sound one was.
        """
        if self.header[number] != SOUND:
            return None
        return int(self.size[number]), int(self.modified[number])

    def forgetting(self, numbers: Iterable[int]) -> "FolderIndex":
        """Return the index without what it knows of some files' headers."""
        header = self.header.copy()
        header[list(numbers)] = UNSEEN
        return replace(self, header=header)


class IndexedFiles(Sequence[Path]):
    """`IndexedFiles` are some files of an index, in an order of their own.

    Args:
        index: of all files.
        numbers: of these files in it.
    """

    def __init__(self, index: FolderIndex, numbers: np.ndarray) -> None:
        self.index, self.numbers = index, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, place: int) -> Path: ...
    @overload
    def __getitem__(self, place: slice) -> "IndexedFiles": ...
    def __getitem__(self, place: int | slice) -> "Path | IndexedFiles":
        """Return a file's path, or some of the files."""
        if isinstance(place, slice):
            return IndexedFiles(self.index, self.numbers[place])
        return self.index.path(int(self.numbers[place]))

    def recorded(self, place: int) -> tuple[int, int] | None:
        """Return what the index recorded of a file; see `FolderIndex.recorded`."""
        return self.index.recorded(int(self.numbers[place]))


def listed(root: Path, endings: tuple[str, ...]) -> tuple[list[str], int]:
    """Return the names of the files under a folder, in the order of their paths part by part, and
    how many folders they lie in.

    Links to folders are followed, each real folder once.  Names that begin with a dot are left out.
    A folder that cannot be read is named in a warning.

    Args:
        root: the folder.
        endings: of the wanted files, in lower case.
    """
    found: list[str] = []
    waiting, visited = [""], set[str]()
    while waiting:
        folder = waiting.pop()
        real = os.path.realpath(root / folder)
        if real in visited:
            continue
        visited.add(real)
        inner = []
        before = os.path.join(folder, "")
        try:
            with os.scandir(root / folder) as entries:
                for entry in entries:
                    name = entry.name
                    if name.startswith("."):
                        continue
                    if _is_folder(entry):
                        inner.append(before + name)
                    elif name.lower().endswith(endings):
                        found.append(before + name)
        except OSError as error:
            _log.warning(
                "%s: cannot be read (%s); passed over", root / folder, error.strerror or error
            )
        waiting += sorted(inner, reverse=True)
    # A separator comes before all that names may hold.
    return sorted(found, key=lambda name: name.replace(os.sep, "\0")), len(visited)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # links in a circle
        return False


# Files from which on a folder is worth an index on disk: a smaller one is looked at in a moment.
LEAST = 2000
# What is known of headers, as arrays of numbers.
_KNOWN = ("header", "size", "modified")
_DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)


class IndexFile:
    """The file in which the index of a folder is kept.

    Args:
        folder: whose index it is.
        endings: of the photographs' files, in lower case.
        kept: False: nothing is read or written.
    """

    def __init__(self, folder: Path, endings: tuple[str, ...], kept: bool = True) -> None:
        self.folder, self.endings, self.kept = folder, endings, kept

    @property
    def path(self) -> Path:
        """The file's path; it follows from the folder's and the endings."""
        key = json.dumps([os.path.abspath(self.folder), self.endings])
        digest = hashlib.sha256(key.encode()).hexdigest()[:32]
        return user_cache_folder() / "folders" / f"{digest}.npz"

    def index(self) -> FolderIndex:
        """List the folder, and return its index with what the kept one knows of the files.

        Raises:
            InputError: the folder does not exist, is no folder, or holds no photograph.
        """
        endings = ", ".join(self.endings)
        if not self.folder.is_dir():
            state = "is not a folder" if self.folder.exists() else "does not exist"
            raise InputError(
                f"{self.folder}: {state}; allowed: a folder of images ending in {endings}"
            )
        started = time.perf_counter()
        with stage(f"listing {self.folder}"):
            names, folders = listed(self.folder, self.endings)
            before = self._read() if self.kept else None
        if not names:
            raise InputError(
                f"{self.folder}: no images in this folder; allowed: files ending in {endings}"
            )
        count, packed = len(names), PackedNames.of(names)
        if before is not None and np.array_equal(before.names.text, packed.text):
            index, known = before, count
        else:
            index, known = self._unseen(packed), 0
            if before is not None:
                numbers = {name: number for number, name in enumerate(before.names)}
                origin = np.array([numbers.get(name, -1) for name in names], dtype=np.int64)
                still = origin >= 0
                known = int(still.sum())
                for name in _KNOWN:
                    getattr(index, name)[still] = getattr(before, name)[origin[still]]
        if known or count >= LEAST:
            seconds = time.perf_counter() - started
            _log.info(
                "%s: %d photographs in %d folders, %d of them known from the index in the cache, "
                "%.1f s",
                *(self.folder, count, folders, known, seconds),
            )
        return index

    def _unseen(self, names: PackedNames) -> FolderIndex:
        """Return an index that knows nothing of the files."""
        count = len(names)
        return FolderIndex(
            self.folder,
            names,
            np.full(count, UNSEEN, dtype=np.uint8),
            *(np.zeros(count, dtype=np.int64) for _ in range(2)),
        )

    def keep(self, index: FolderIndex) -> None:
        """Write an index for the next start; where that fails, one line says so."""
        if not self.kept or len(index) < LEAST:
            return
        content = io.BytesIO()
        arrays = {name: getattr(index, name) for name in _KNOWN}
        np.savez(content, names=index.names.text, **arrays)
        try:
            path = self.path
            if not path.parent.is_dir():
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            delete_old(path.parent)
            write_whole(path, content.getvalue())
        except (OSError, RuntimeError) as error:  # no home folder
            _log.warning("%s: the index cannot be kept for the next start: %s", self.folder, error)

    def _read(self) -> FolderIndex | None:
        """Read the kept index; None where there is none."""
        try:
            path = self.path
            if not path.is_file():
                return None
            found = _index_in(path, self.folder)
            os.utime(path)  # so that it is not deleted as forgotten
            return found
        except RuntimeError:
            return None
        except _DAMAGE as error:
            line = str(error).partition("\n")[0]
            _log.warning(
                "%s: the index is damaged (%s), and made anew: %s", self.folder, line, path
            )
            return None


def _index_in(path: Path, folder: Path) -> FolderIndex:
    """Read an index, and check that its parts belong together."""
    with np.load(path, allow_pickle=False) as content:
        arrays: dict[str, Any] = {name: content[name] for name in _KNOWN}
        names = PackedNames(content["names"])
    shape = (len(names),)
    if any(array.shape != shape or array.dtype.kind not in "iu" for array in arrays.values()):
        raise ValueError("arrays of other lengths")
    if len(names) and arrays["header"].max() > REFUSED:
        raise ValueError("numbers out of range")
    return FolderIndex(folder, names, **arrays)


# Threads wait for disks, and for other machines' disks; they do not compute at once.
_THREADS = 8
# Files that a thread looks at in one go, and how often the log says how far it is, in seconds.
_TOGETHER = 512
_SAID_EVERY = 15.0


def with_headers(
    index: FolderIndex,
    numbers: np.ndarray,
    keep: Callable[[FolderIndex], None],
    megapixels: float,
) -> tuple[FolderIndex, dict[int, str]]:
    """Read the headers of files that no header is known of, and of those that were refused.

    Args:
        index: of the files.
        numbers: of those that count.
        keep: is given an index that has learnt something; when reading is interrupted too, so that
            the next start goes on from there.
        megapixels: the largest photograph that is read, millions of pixels.

    Returns:
        The index with what was found, and why each refused file is refused.
    """
    wanted = numbers[index.header[numbers] != SOUND]
    if not len(wanted):
        return index, {}
    found = replace(index, **{name: getattr(index, name).copy() for name in _KNOWN})
    refused: dict[int, str] = {}

    def look(some: np.ndarray) -> None:
        for number in some.tolist():
            path = index.folder / index.names[number]
            # The status first: a file that changes meanwhile is noticed when it is used.
            try:
                status = os.stat(path)
                found.size[number], found.modified[number] = status.st_size, status.st_mtime_ns
            except OSError:
                found.size[number] = found.modified[number] = -1
            reason = probe_picture(path, megapixels)
            found.header[number] = SOUND if reason is None else REFUSED
            if reason is not None:
                refused[number] = reason

    pieces = [wanted[begin : begin + _TOGETHER] for begin in range(0, len(wanted), _TOGETHER)]
    try:
        with stage(f"reading the headers of {len(wanted)} photographs"):
            _in_threads(look, pieces, len(wanted))
    finally:
        if any(not np.array_equal(getattr(found, name), getattr(index, name)) for name in _KNOWN):
            keep(found)
    return found, dict(sorted(refused.items()))


def _in_threads(look: Callable[[np.ndarray], None], pieces: list[np.ndarray], total: int) -> None:
    if len(pieces) == 1:
        look(pieces[0])
        return
    said = time.perf_counter()
    done = 0
    pool = ThreadPoolExecutor(_THREADS)
    try:
        for piece, _ in zip(pieces, pool.map(look, pieces), strict=True):
            done += len(piece)
            if time.perf_counter() - said > _SAID_EVERY:
                said = time.perf_counter()
                _log.info("read the headers of %d of %d photographs", done, total)
    finally:
        pool.shutdown(cancel_futures=True)
