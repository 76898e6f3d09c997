"""Folders are walked, and those that have not changed are not read again."""

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

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
