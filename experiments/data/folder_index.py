"""An index knows the photographs under a folder, without opening them again."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

from dolens.errors import InputError
from dolens.experiments.data.folder_listing import Listing
from dolens.experiments.data.packed_names import PackedNames

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
