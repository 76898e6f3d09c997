"""An index lists the photographs under a folder; what has not changed is not read again."""

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np

from dolens.errors import InputError

_log = logging.getLogger(__name__)

# Seconds for which a file system may give two changes of a folder the same time.
_SAME_TIME = 2.0


class Listing(NamedTuple):
    """A `Listing` is what a folder holds.

    Attributes:
        folder: path below the one that is walked; empty for that one itself.
        stamp: times of its last change, ns, by which another change is noticed; empty where a
            change would go unnoticed.
        folders: names of the folders in it.
        links: names of links in it that lead to no file; where they lead may change any time.
        files: names of the wanted files in it; None: those known before.
    """

    folder: str
    stamp: list[int]
    folders: list[str]
    links: list[str]
    files: list[str] | None


def walked(
    root: Path, endings: tuple[str, ...], known: Mapping[str, Listing] | None = None
) -> Iterator[Listing]:
    """List a folder and all below it, each real folder once, in the order of their names.

    Links to folders are followed.  Names that begin with a dot are left out.  A folder that cannot
    be read is named in a warning.

    Args:
        root: the folder.
        endings: of the wanted files, in lower case.
        known: earlier listings; a folder whose stamp is still the same is not read again.
    """
    known = known or {}
    waiting = [("", os.path.realpath(root))]
    visited: set[str] = set()
    while waiting:
        folder, real = waiting.pop()
        if real in visited:
            continue
        visited.add(real)
        listing = _listed(root, folder, endings, known.get(folder))
        yield listing
        linked = {name for name in listing.links if (root / folder / name).is_dir()}
        for name in sorted([*listing.folders, *linked], reverse=True):
            path = os.path.join(folder, name)
            of_link = os.path.realpath(root / path) if name in linked else None
            waiting.append((path, of_link or os.path.join(real, name)))


def _listed(root: Path, folder: str, endings: tuple[str, ...], known: Listing | None) -> Listing:
    path = root / folder
    try:
        status = path.stat()  # before the folder is read, so that a change meanwhile is noticed
        stamp = [status.st_mtime_ns, status.st_ctime_ns]
        if known is not None and known.stamp == stamp:
            return known._replace(files=None)
        if max(stamp) > (time.time() - _SAME_TIME) * 1e9:
            stamp = []
        found = Listing(folder, stamp, [], [], [])
        with os.scandir(path) as entries:
            for entry in entries:
                if not entry.name.startswith("."):
                    _add(found, entry, endings)
        return found
    except OSError as error:
        _log.warning("%s: cannot be read (%s); passed over", path, error.strerror or error)
        return Listing(folder, [], [], [], [])


def _add(found: Listing, entry: os.DirEntry[str], endings: tuple[str, ...]) -> None:
    is_folder = _leads(entry.is_dir)
    if entry.is_symlink() and not _leads(entry.is_file):
        found.links.append(entry.name)
    elif is_folder:
        found.folders.append(entry.name)
    if not is_folder and os.path.splitext(entry.name)[1].lower() in endings:
        found.files.append(entry.name)


def _leads(to: Callable[[], bool]) -> bool:
    """Return whether an entry is what `to` asks for, which links in a circle are not."""
    try:
        return to()
    except OSError:
        return False


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
    """A `FolderIndex` lists the photographs under a folder, sorted by their paths as text.

    Attributes:
        folder: all of them lie below it.
        listings: of the folder and those below it, without their files' names.
        names: of the files, below the folder.
        listing: number of the listing that each file stands in, int32.
        order: numbers of the files in the order of their paths part by part, int32.
        header: UNSEEN, SOUND or REFUSED, uint8.
        size: of the file when its header was read, bytes, int64.
        modified: when it had last been written to then, ns, int64.
    """

    folder: Path
    listings: tuple[Listing, ...]
    names: PackedNames
    listing: np.ndarray
    order: np.ndarray
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

    def ranks(self) -> np.ndarray:
        """Return the place of each file in the order of paths part by part."""
        ranks = np.empty(len(self), dtype=np.int64)
        ranks[self.order] = np.arange(len(self))
        return ranks


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


def check_folder(folder: Path, endings: tuple[str, ...]) -> None:
    """Check that a folder is there.

    Raises:
        InputError: it does not exist, or is no folder.
    """
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(
            f"{folder}: {state}; allowed: a folder of images ending in {', '.join(endings)}"
        )


def index_of(
    folder: Path, listings: Sequence[Listing], known: FolderIndex | None = None
) -> FolderIndex:
    """Make the index of a folder from its listings.

    Args:
        folder: the folder.
        listings: of it and of all below; see `walked`.
        known: the earlier index, from which come the names of the folders that are as they were,
            and what was known of the files that are still there.
    """
    names: list[str] = []
    earlier: list[np.ndarray] = [np.empty(0, dtype=np.int64)]
    counts: list[int] = []
    before = _files_by_listing(known)
    for listing in listings:
        old = before.get(listing.folder, {})
        if listing.files is None:
            found = list(old)
        else:
            found = [os.path.join(listing.folder, name) for name in listing.files]
        names += found
        counts.append(len(found))
        earlier.append(np.array([old.get(name, -1) for name in found], dtype=np.int64))
    by_text = np.array(sorted(range(len(names)), key=names.__getitem__), dtype=np.int64)
    origin = np.concatenate(earlier)[by_text]
    ordered = [names[number] for number in by_text]
    parts = [name.replace(os.sep, "\0") for name in ordered]  # before all that names may hold
    header = np.zeros(len(names), dtype=np.uint8)
    size, modified = (np.zeros(len(names), dtype=np.int64) for _ in range(2))
    if known is not None:
        still = origin >= 0
        for new, old_values in (
            (header, known.header),
            (size, known.size),
            (modified, known.modified),
        ):
            new[still] = old_values[origin[still]]
    return FolderIndex(
        folder,
        tuple(listing._replace(files=None) for listing in listings),
        PackedNames.of(ordered),
        np.repeat(np.arange(len(listings), dtype=np.int32), counts)[by_text],
        np.array(sorted(range(len(parts)), key=parts.__getitem__), dtype=np.int32),
        header,
        size,
        modified,
    )


def _files_by_listing(known: FolderIndex | None) -> dict[str, dict[str, int]]:
    """Return the names of an index's files, each with its number, by the folder they lie in."""
    if known is None:
        return {}
    found: list[dict[str, int]] = [{} for _ in known.listings]
    for number, (name, listing) in enumerate(zip(known.names, known.listing.tolist(), strict=True)):
        found[listing][name] = number
    return {listing.folder: files for listing, files in zip(known.listings, found, strict=True)}
