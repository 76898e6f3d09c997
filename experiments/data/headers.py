"""Headers of very many photographs are read by several threads."""

import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from dolens.experiments.data.folder_index import REFUSED, SOUND, FolderIndex
from dolens.sensor.pictures import probe_picture
from dolens.tasks import stage

_log = logging.getLogger(__name__)

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
