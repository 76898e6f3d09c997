"""Indices of large folders are kept in the user's cache folder, with the photographs' headers.

A file holds arrays of numbers and text; nothing in it is executed.
"""

import hashlib
import io
import json
import logging
import os
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dolens.errors import InputError
from dolens.experiments.data.folder_index import (
    REFUSED,
    SOUND,
    FolderIndex,
    Listing,
    PackedNames,
    check_folder,
    index_of,
    walked,
)
from dolens.files import delete_old, user_cache_folder, write_whole
from dolens.sensor.pictures import probe_picture
from dolens.tasks import stage

_log = logging.getLogger(__name__)

# Files from which on a folder is worth an index on disk: a smaller one is looked at in a moment.
LEAST = 2000
# What of an index is kept as arrays of numbers.
_ARRAYS = ("listing", "order", "header", "size", "modified")
_DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)


class IndexFile:
    """The file in which the index of a folder is kept.

    Args:
        folder: whose index it is.
        endings: of the photographs' files, in lower case.
        kept: False: nothing is read or written, and the folder is listed anew.
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
        """Return the folder's index: the kept one where no folder has changed since, and else one
        that is made anew from the folders that have.

        Raises:
            InputError: the folder does not exist, is no folder, or holds no photograph.
        """
        check_folder(self.folder, self.endings)
        started = time.perf_counter()
        with stage(f"listing {self.folder}"):
            known = self._read() if self.kept else None
            found = self._checked(known)
        if not len(found):
            raise InputError(
                f"{self.folder}: no images in this folder; allowed: files ending in "
                f"{', '.join(self.endings)}"
            )
        seconds = time.perf_counter() - started
        if found is known:
            said = "the index in the cache holds"
        elif known is None:
            said = "listed"
        else:
            said = f"folders have changed, and the index with them ({len(known)} files before)"
        if known is not None or len(found) >= LEAST:
            _log.info(
                "%s: %d photographs in %d folders, %s, %.1f s",
                *(self.folder, len(found), len(found.listings), said, seconds),
            )
        if found is not known:
            self.keep(found)
        return found

    def keep(self, index: FolderIndex) -> None:
        """Write an index for the next start; where that fails, one line says so."""
        if not self.kept or len(index) < LEAST:
            return
        listings = [[*listing[:4]] for listing in index.listings]
        arrays = {name: getattr(index, name) for name in _ARRAYS}
        content = io.BytesIO()
        np.savez(
            content, names=index.names.text, listings=_bytes_of(json.dumps(listings)), **arrays
        )
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

    def _checked(self, known: FolderIndex | None) -> FolderIndex:
        """Return the known index where all folders are as they were, and else a new one."""
        before = {} if known is None else {listing.folder: listing for listing in known.listings}
        listings = list(walked(self.folder, self.endings, before))
        same = known is not None and [entry.folder for entry in listings] == list(before)
        if same and all(entry.files is None for entry in listings):
            return known
        return index_of(self.folder, listings, known)


def _index_in(path: Path, folder: Path) -> FolderIndex:
    """Read an index, and check that its parts belong together."""
    with np.load(path, allow_pickle=False) as content:
        arrays: dict[str, Any] = {name: content[name] for name in _ARRAYS}
        names = PackedNames(content["names"])
        text = content["listings"].tobytes().decode()
    listings = tuple(
        Listing(
            str(place),
            [int(t) for t in stamp],
            list(map(str, folders)),
            list(map(str, links)),
            None,
        )
        for place, stamp, folders, links in json.loads(text)
    )
    count = len(names)
    if any(array.shape != (count,) or array.dtype.kind not in "iu" for array in arrays.values()):
        raise ValueError("arrays of other lengths")
    if count and not (
        0 <= arrays["listing"].min() <= arrays["listing"].max() < len(listings)
        and np.array_equal(np.sort(arrays["order"]), np.arange(count))
        and arrays["header"].max() <= REFUSED
    ):
        raise ValueError("numbers out of range")
    return FolderIndex(folder, listings, names, **arrays)


def _bytes_of(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), dtype=np.uint8)


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
    header, size, modified = index.header.copy(), index.size.copy(), index.modified.copy()
    refused: dict[int, str] = {}

    def look(some: np.ndarray) -> None:
        for number in some.tolist():
            path = index.folder / index.names[number]
            # The status first: a file that changes meanwhile is noticed when it is used.
            try:
                status = os.stat(path)
                size[number], modified[number] = status.st_size, status.st_mtime_ns
            except OSError:
                size[number] = modified[number] = -1
            reason = probe_picture(path, megapixels)
            header[number] = SOUND if reason is None else REFUSED
            if reason is not None:
                refused[number] = reason

    pieces = [wanted[begin : begin + _TOGETHER] for begin in range(0, len(wanted), _TOGETHER)]
    try:
        with stage(f"reading the headers of {len(wanted)} photographs"):
            _in_threads(look, pieces, len(wanted))
    finally:
        found = replace(index, header=header, size=size, modified=modified)
        if any(
            not np.array_equal(getattr(found, name), getattr(index, name))
            for name in ("header", "size", "modified")
        ):
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
