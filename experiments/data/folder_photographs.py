"""Photographs stay on disk until they are asked for."""

import logging
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from dolens.errors import InputError
from dolens.experiments.data.photographs import Photograph, read_photograph

_log = logging.getLogger(__name__)


class FolderPhotographs(Sequence[Photograph]):
    """`FolderPhotographs` decodes photographs of a folder on demand, and keeps the latest in
    memory.

    A file that cannot be decoded is replaced by the next in the list that can, always the same
    one, and named in one warning.  The record of such files is shared with the worker
    processes of a loader, so that `unreadable` is complete in the process that made this.

    Args:
        folder: named in the message when nothing can be read.
        paths: the files, in the order of their numbers.
        cache_bytes: decoded pixels kept in memory, in each process; the latest photograph is
            kept whatever its size.
        read: reads a file; raises `InputError` where it cannot.

    Raises:
        InputError: there are no paths.
    """

    def __init__(
        self,
        folder: Path,
        paths: Sequence[Path],
        cache_bytes: int = 2**28,
        read: Callable[[Path], Photograph] = read_photograph,
    ) -> None:
        if len(paths) == 0:
            raise InputError(f"{folder}: no photographs; allowed: at least one")
        self.folder = folder
        self.paths = list(paths)
        self.cache_bytes = cache_bytes
        self._decode = read
        self._cache: OrderedDict[int, Photograph] = OrderedDict()
        self._cached_bytes = 0
        self._unreadable = torch.zeros(len(self.paths), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, number: int) -> Photograph:  # type: ignore[override]
        """Return photograph `number`, or the next one that can be decoded.

        Raises:
            IndexError: there is no such number.
            InputError: no file of the list can be decoded.
        """
        if not 0 <= number < len(self.paths):
            raise IndexError(f"photograph {number} of {len(self.paths)}")
        for step in range(len(self.paths)):
            candidate = (number + step) % len(self.paths)
            photograph = self._read(candidate)
            if photograph is not None:
                return photograph
        raise InputError(
            f"{self.folder}: none of {len(self.paths)} files can be decoded; allowed: images "
            "Pillow can read"
        )

    @property
    def unreadable(self) -> list[Path]:
        """Return the files found to be unreadable so far, by any process."""
        return [self.paths[number] for number in self._unreadable.nonzero().flatten().tolist()]

    def _read(self, number: int) -> Photograph | None:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        if self._unreadable[number]:
            return None
        try:
            photograph = self._decode(self.paths[number])
        except InputError as error:
            self._unreadable[number] = True
            _log.warning(
                "%s; the next readable file takes its place; skipped %d unreadable files of %d",
                error,
                int(self._unreadable.sum()),
                len(self.paths),
            )
            return None
        self._keep(number, photograph)
        return photograph

    def _keep(self, number: int, photograph: Photograph) -> None:
        self._cache[number] = photograph
        self._cached_bytes += photograph.nbytes
        while self._cached_bytes > self.cache_bytes and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= dropped.nbytes
