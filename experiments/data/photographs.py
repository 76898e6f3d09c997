"""Photographs are read from disk, at once or when they are asked for."""

import logging
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.sensor.image_files import MEGAPIXELS
from dolens.sensor.pictures import read_pixels

EXTENSIONS: tuple[str, ...] = (
    ".bmp",
    ".gif",
    ".jpeg",
    ".jpg",
    ".png",
    ".ppm",
    ".tif",
    ".tiff",
    ".webp",
)
"""The endings of files taken for photographs, in lower case; the case of a file is ignored."""


@dataclass(frozen=True)
class Photograph:
    """A `Photograph` has a name, and is kept sRGB-encoded in one byte a channel to save memory.

    Attributes:
        name: how messages name it, as a rule its path.
        encoded: (3, height, width) uint8, sRGB-encoded.
        depth: (height, width) float32, mm, or None where nothing is known of it.
        notes: what of its file was not taken as it stands, a sentence each.

    Raises:
        InputError: `encoded` has another shape or dtype, or no pixels; or the depth another size.
    """

    name: str
    encoded: Tensor
    depth: Tensor | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shape = tuple(self.encoded.shape)
        if (
            self.encoded.dtype != torch.uint8
            or len(shape) != 3
            or shape[0] != 3
            or self.encoded.numel() == 0
        ):
            raise InputError(
                f"photograph {self.name}: {self.encoded.dtype} of shape {shape}; "
                "allowed: torch.uint8 of shape (3, height, width), not empty"
            )
        if self.depth is not None and self.depth.shape != self.encoded.shape[1:]:
            raise InputError(
                f"photograph {self.name}: {self.height}×{self.width} pixels and a depth map of "
                f"{'×'.join(map(str, self.depth.shape))}; allowed: the same size"
            )

    @property
    def nbytes(self) -> int:
        """Return the memory it takes, bytes."""
        return self.encoded.nbytes + (0 if self.depth is None else self.depth.nbytes)

    @property
    def height(self) -> int:
        """Return the number of rows, pixels."""
        return self.encoded.shape[1]

    @property
    def width(self) -> int:
        """Return the number of columns, pixels."""
        return self.encoded.shape[2]


def normalised_extensions(extensions: Iterable[str]) -> tuple[str, ...]:
    """Return lower-case endings with their dot: `JPG` and `.jpg` both give `.jpg`.

    Raises:
        InputError: there is none, or one is empty.
    """
    if isinstance(extensions, str):
        extensions = (extensions,)
    given = [str(extension).strip().lower().lstrip(".") for extension in extensions]
    if not given or not all(given):
        raise InputError(f"data.extensions: {given}; allowed: endings such as .png, at least one")
    return tuple(sorted({f".{extension}" for extension in given}))


def read_photograph(
    path: str | Path, name: str | None = None, megapixels: float = MEGAPIXELS
) -> Photograph:
    """Read an image file as a `Photograph`: see `dolens.sensor.pictures.read_pixels`.

    16 bits are rounded to 8; greyscale is repeated in the three channels; transparency is
    composited in linear light over black, where nothing sends light.

    Args:
        path: the file.
        name: name in messages; the path when not given.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file is missing, cannot be decoded, is too large, or holds what has no
            meaning here, such as floating-point pixels.
    """
    name = str(path) if name is None else name
    try:
        pixels = read_pixels(path, megapixels)
    except InputError as error:
        raise InputError(error.whole.replace(str(path), name, 1)) from error
    return Photograph(name, pixels.encoded(), notes=pixels.notes)


_log = logging.getLogger(__name__)

# Files that a process names in warnings of their own; then their number alone is said.
_NAMED = 20
# Unreadable files one after another that mean that all of them are gone.
_MOST_IN_A_ROW = 1000
_DECODED, _UNREADABLE = 1, 2


class FolderPhotographs(Sequence[Photograph]):
    """`FolderPhotographs` decodes photographs of a folder on demand, and keeps the latest in
    memory.

    A file that cannot be decoded is an error, or is replaced by the next in the list that can,
    always the same one, and named in one warning.  A file that is another than when its header was
    read is named in one warning too.  The record of such files is shared with the worker processes
    of a loader, so that `unreadable` is complete in the process that made this.

    Args:
        folder: named in the message when nothing can be read.
        paths: the files, in the order of their numbers.
        cache_bytes: decoded pixels kept in memory, in each process; the latest photograph is
            kept whatever its size.
        read: reads a file; raises `InputError` where it cannot.
        unreadable: `error`, or `skip` for the next readable file in the place of one that is not.
        recorded: gives (bytes, time of the last change in ns) of a file by its number, or None
            where neither is known.

    Raises:
        InputError: there are no paths, or `unreadable` is another word.
    """

    def __init__(
        self,
        folder: Path,
        paths: Sequence[Path],
        cache_bytes: int = 2**28,
        read: Callable[[Path], Photograph] = read_photograph,
        unreadable: str = "error",
        recorded: Callable[[int], tuple[int, int] | None] | None = None,
    ) -> None:
        if len(paths) == 0:
            raise InputError(f"{folder}: no photographs; allowed: at least one")
        check_choice(unreadable, ("error", "skip"), "data.unreadable")
        self.folder = folder
        self.paths = paths
        self.cache_bytes = cache_bytes
        self.skips = unreadable == "skip"
        self._decode = read
        self._recorded = recorded
        self._cache: OrderedDict[int, Photograph] = OrderedDict()
        self._cached_bytes = 0
        self._said: set[str] = set()
        self._seen = torch.zeros(len(paths), dtype=torch.uint8).share_memory_()
        self._changed = torch.zeros(len(paths), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, number: int) -> Photograph:  # type: ignore[override]
        """Return photograph `number`, or the next one that can be decoded.

        Raises:
            IndexError: there is no such number.
            InputError: the file cannot be decoded; or no file of the list, or none of very many
                that follow one another.
        """
        for candidate in self._candidates(number):
            photograph = self._read(candidate)
            if photograph is not None:
                return photograph
        raise self._hopeless()

    def name(self, number: int) -> str:
        """Return the name of the photograph that `self[number]` returns; a file is decoded for it
        only where it may be skipped and nobody has decoded it.

        Raises:
            IndexError: there is no such number.
            InputError: as for `self[number]`.
        """
        for candidate in self._candidates(number):
            if self._seen[candidate] == _DECODED or not self.skips:
                return str(self.paths[candidate])
            photograph = self._read(candidate)
            if photograph is not None:
                return photograph.name
        raise self._hopeless()

    @property
    def unreadable(self) -> list[Path]:
        """Return the files found to be unreadable so far, by any process."""
        found = (self._seen == _UNREADABLE).nonzero().flatten().tolist()
        return [self.paths[number] for number in found]

    @property
    def changed(self) -> list[int]:
        """Return the numbers of the files found to be others than recorded, by any process."""
        return self._changed.nonzero().flatten().tolist()

    def _candidates(self, number: int) -> Iterator[int]:
        if not 0 <= number < len(self.paths):
            raise IndexError(f"photograph {number} of {len(self.paths)}")
        tried = min(len(self.paths), _MOST_IN_A_ROW)
        return ((number + step) % len(self.paths) for step in range(tried))

    def _hopeless(self) -> InputError:
        tried = min(len(self.paths), _MOST_IN_A_ROW)
        whose = "none of" if tried == len(self.paths) else "one after another, none of"
        return InputError(
            f"{self.folder}: {whose} {tried} files can be decoded; allowed: images Pillow can read"
        )

    def _read(self, number: int) -> Photograph | None:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        if self._seen[number] == _UNREADABLE:
            return None
        path = self.paths[number]
        self._compare(number, path)
        try:
            photograph = self._decode(path)
        except InputError as error:
            if not self.skips:
                raise InputError(f"{error}; data.unreadable=skip goes on without it") from error
            self._seen[number] = _UNREADABLE
            self._warn(error)
            return None
        self._seen[number] = _DECODED
        for note in set(photograph.notes) - self._said:
            self._said.add(note)
            _log.warning("%s: %s (of other files alike this is not said again)", path, note)
        self._keep(number, photograph)
        return photograph

    def _warn(self, error: InputError) -> None:
        count = int((self._seen == _UNREADABLE).sum())
        if count <= _NAMED or str(count).strip("0") == "1":
            _log.warning(
                "%s; the next readable file takes its place; skipped %d unreadable files of %d",
                error,
                count,
                len(self.paths),
            )

    def _compare(self, number: int, path: Path) -> None:
        """Say it once where a file is another than when its header was read."""
        recorded = None if self._recorded is None else self._recorded(number)
        if recorded is None or self._changed[number]:
            return
        try:
            status = os.stat(path)
        except OSError:
            return  # reading it says so
        if (status.st_size, status.st_mtime_ns) != recorded:
            self._changed[number] = True
            count = int(self._changed.sum())
            if count <= _NAMED or str(count).strip("0") == "1":
                _log.warning(
                    "%s: changed since its header was read (%d files so far); it is taken as it is",
                    path,
                    count,
                )

    def _keep(self, number: int, photograph: Photograph) -> None:
        self._cache[number] = photograph
        self._cached_bytes += photograph.nbytes
        while self._cached_bytes > self.cache_bytes and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= dropped.nbytes


_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")


def shown_name(name: str) -> str:
    """Return a photograph's name without the suffix of its file, if it has one of an image."""
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and dot + suffix.lower() in _IMAGE_SUFFIXES else name
