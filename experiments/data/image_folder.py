"""Photographs are read from any folder of images, with depth maps beside them or without."""

import hashlib
import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from dolens.errors import InputError, check_choice
from dolens.experiments.data.camera_data import CropDataModule, Split
from dolens.experiments.data.folder_index import (
    SOUND,
    FolderIndex,
    IndexedFiles,
    IndexFile,
    with_headers,
)
from dolens.experiments.data.photographs import (
    EXTENSIONS,
    FolderPhotographs,
    Photograph,
    normalised_extensions,
    read_photograph,
)
from dolens.sensor.image_files import MEGAPIXELS, read_numbers

_log = logging.getLogger(__name__)

# Files without a sound header that warnings of their own name; all are counted.
_NAMED = 20
_SEPARATOR = os.sep.encode()


class ImageFolderDataModule(CropDataModule):
    """`ImageFolderDataModule` cuts crops of the images under a folder, decoded on demand.

    A root with subfolders `train` and `val` (and `test`), such as ImageNet's, is split by
    them; without `test`, the files under `val` are divided between validation and test in the
    ratio of their fractions.  Any other folder is split by files: a hash of the seed and the
    path below the root decides, so that adding a file leaves the others where they are (a
    split that would be empty takes the file nearest to it).

    Args:
        root: the folder, searched recursively.
        validation_fraction: share of the files for validation, above 0.
        test_fraction: share of the files for test, above 0.
        evaluation_limit: the most photographs to use in validation, and in test; chosen by
            their hash.  None: all.
        **crops: the arguments of `CropDataModule`.

    Rarely needed:
        extensions: endings of the files to take; case is ignored.
        verify: look at every file's header at set-up and leave out those that are no images.  The
            index remembers what was found, so that only the first start takes long.
        unreadable: `error` where a file cannot be decoded when its turn comes; `skip` takes the
            next readable file in its place, names it, and counts such files.
        index: keep what is known of the files' headers in the user's cache folder, for the next
            start; small folders have no index.
        cache_bytes: decoded pixels kept in memory, in each split and process.
        megapixels: the largest photograph that is read, millions of pixels; a larger one counts as
            unreadable, and is not decoded.

    Raises:
        InputError: an argument is out of range; at set-up, the folder is missing, empty, holds
            no readable image, or too few files to split.
    """

    def __init__(
        self,
        root: str | Path,
        extensions: Sequence[str] = EXTENSIONS,
        validation_fraction: float = 0.1,
        test_fraction: float = 0.1,
        evaluation_limit: int | None = None,
        verify: bool = True,
        cache_bytes: int = 2**28,
        unreadable: Literal["error", "skip"] = "error",
        index: bool = True,
        megapixels: float = MEGAPIXELS,
        **crops: Any,
    ) -> None:
        super().__init__(**crops)
        for key, fraction in (
            ("data.validation_fraction", validation_fraction),
            ("data.test_fraction", test_fraction),
        ):
            if not 0 < fraction < 1:
                raise InputError(f"{key}: {fraction}; allowed: above 0 and below 1")
        if validation_fraction + test_fraction >= 1:
            raise InputError(
                "data.validation_fraction and data.test_fraction: "
                f"{validation_fraction} and {test_fraction}; allowed: together below 1"
            )
        if evaluation_limit is not None and evaluation_limit < 1:
            raise InputError(
                f"data.evaluation_limit: {evaluation_limit}; allowed: 1 or more, or null"
            )
        check_choice(unreadable, ("error", "skip"), "data.unreadable")
        self.root = Path(root).expanduser()
        self.extensions = normalised_extensions(extensions)
        self.validation_fraction = validation_fraction
        self.test_fraction = test_fraction
        self.evaluation_limit = evaluation_limit
        self.verify = verify
        self.cache_bytes = cache_bytes
        self.unreadable = unreadable
        self.index = index
        self.megapixels = megapixels
        self._paths: dict[Split, IndexedFiles] | None = None
        self._indices: list[tuple[IndexFile, FolderIndex]] = []
        self._refused: dict[Path, None] = {}

    @property
    def skipped_files(self) -> list[Path]:
        """Return the files left out or replaced so far because they cannot be read, sorted."""
        found = set(self._refused)
        for photographs in self._opened():
            found.update(photographs.unreadable)
        return sorted(found)

    @property
    def paths(self) -> dict[Split, IndexedFiles]:
        """Return the files of each split, listed (and verified, if asked for) at the first call.

        Raises:
            InputError: as at set-up.
        """
        if self._paths is None:
            self._paths = self._listed()
        return self._paths

    def prepare_data(self) -> None:
        """List the files; of several processes one does so first, and the others find its index."""
        self.paths  # noqa: B018

    def load_split(self, split: Split) -> FolderPhotographs:
        """Return the photographs of a split, none of them decoded yet."""
        read = partial(read_photograph, megapixels=self.megapixels)
        return self._photographs_of(split, read)

    def teardown(self, stage: str) -> None:
        """Report how many files could not be read; the index forgets files that have changed."""
        skipped = self.skipped_files
        if skipped and self._paths is not None:
            total = sum(len(paths) for paths in self._paths.values()) + len(self._refused)
            _log.warning("skipped %d unreadable files of %d in %s", len(skipped), total, self.root)
        for file, index in self._indices:
            changed = [
                int(files.numbers[place])
                for photographs in self._opened()
                for files in (photographs.paths,)
                if isinstance(files, IndexedFiles) and files.index is index
                for place in photographs.changed
            ]
            if changed:
                file.keep(index.forgetting(changed))

    def _opened(self) -> list[FolderPhotographs]:
        found = self._photographs.values()
        return [photographs for photographs in found if isinstance(photographs, FolderPhotographs)]

    def _photographs_of(
        self, split: Split, read: Callable[[Path], Photograph]
    ) -> FolderPhotographs:
        """Return the photographs of a split, which `read` is to decode."""
        files = self.paths[split]
        return FolderPhotographs(
            self.root, files, self.cache_bytes, read, self.unreadable, files.recorded
        )

    def _listed(self) -> dict[Split, IndexedFiles]:
        train, validation, test = (self.root / name for name in ("train", "val", "test"))
        if train.is_dir() and validation.is_dir():
            listed = {folder: self._list(folder) for folder in (train, validation)}
            if test.is_dir():
                return {
                    "train": listed[train],
                    "validation": self._limited(listed[validation]),
                    "test": self._limited(self._list(test)),
                }
            share = self.test_fraction / (self.test_fraction + self.validation_fraction)
            test_paths, validation_paths = self._divided(listed[validation], [share])
            _log.info(
                "%s: no folder test; %d of the files under val are for test",
                self.root,
                len(test_paths),
            )
            train_paths = listed[train]
        else:
            test_paths, validation_paths, train_paths = self._divided(
                self._list(self.root),
                [self.test_fraction, self.test_fraction + self.validation_fraction],
            )
        return {
            "train": train_paths,
            "validation": self._limited(validation_paths),
            "test": self._limited(test_paths),
        }

    def _list(self, folder: Path) -> IndexedFiles:
        """List the files under a folder, without those whose header Pillow refuses."""
        file = IndexFile(folder, self.extensions, self.index)
        index = file.index()
        numbers = self._wanted(index)
        if not self.verify:
            self._indices.append((file, index))
            return IndexedFiles(index, numbers)
        index, refused = with_headers(index, numbers, file.keep, self.megapixels)
        self._indices.append((file, index))
        for place, (number, reason) in enumerate(refused.items()):
            self._refused[index.path(number)] = None
            if place < _NAMED:
                _log.warning("%s: not a readable image (%s); skipped", index.path(number), reason)
        readable = numbers[index.header[numbers] == SOUND]
        if not len(readable):
            raise InputError(
                f"{folder}: none of {len(refused)} files is a readable image; allowed: images "
                f"ending in {', '.join(self.extensions)}"
            )
        if refused:
            _log.warning(
                "skipped %d unreadable files of %d in %s", len(refused), len(numbers), folder
            )
        return IndexedFiles(index, readable)

    def _wanted(self, index: FolderIndex) -> np.ndarray:
        """Return the numbers of the photographs among a folder's files; none is opened."""
        return np.arange(len(index), dtype=np.int32)

    def _divided(self, files: IndexedFiles, bounds: list[float]) -> list[IndexedFiles]:
        """Divide the files by their hashes at each bound; no part is empty."""
        if len(files) <= len(bounds):
            raise InputError(
                f"{self.root}: {len(files)} readable images for {len(bounds) + 1} splits; "
                "allowed: at least one for each"
            )
        values = self._hashes(files)
        hashed = np.argsort(values, kind="stable")
        parts: list[IndexedFiles] = []
        begin = 0
        for position, bound in enumerate([*bounds, math.inf]):
            end = int((values < bound).sum())
            end = max(end, begin + 1)
            end = min(end, len(files) - (len(bounds) - position))
            numbers = np.sort(files.numbers[hashed[begin:end]])
            parts.append(IndexedFiles(files.index, numbers))
            begin = end
        return parts

    def _limited(self, files: IndexedFiles) -> IndexedFiles:
        if self.evaluation_limit is None or len(files) <= self.evaluation_limit:
            return files
        first = np.argsort(self._hashes(files), kind="stable")[: self.evaluation_limit]
        return IndexedFiles(files.index, np.sort(files.numbers[first]))

    def _hashes(self, files: IndexedFiles) -> np.ndarray:
        """Return a number in [0, 1) for each file, from the seed and its path below the root."""
        below = files.index.folder.relative_to(self.root).as_posix()
        text = f"{self.seed}:" if below == "." else f"{self.seed}:{below}/"
        begun = hashlib.blake2b(text.encode("utf-8", "surrogateescape"), digest_size=8)
        digests = bytearray()
        for name in files.index.names.encoded(files.numbers.tolist()):
            digest = begun.copy()
            digest.update(name.replace(_SEPARATOR, b"/"))
            digests += digest.digest()
        return np.frombuffer(digests, dtype=">u8") / 2.0**64


class RgbdFolderDataModule(ImageFolderDataModule):
    """`RgbdFolderDataModule` cuts crops of photographs with depth (mm) as a fourth channel, for
    `scene=layers`.

    Beside each photograph lies its depth map: `hall.jpg` and `hall_depth.png`.

    Args:
        root: the folder, searched recursively; split as `ImageFolderDataModule` says.
        depth_suffix: ending of a depth map's name after the photograph's.
        depth_unit: mm per unit of the maps' numbers: 1 for millimetres (Kinect), 1000 for metres,
            0.2 for the TUM benchmark's 5000 a metre.
        **settings: those of `ImageFolderDataModule`.

    Raises:
        InputError: an argument is out of range; at set-up, a photograph has no depth map.
    """

    def __init__(
        self,
        root: str | Path,
        depth_suffix: str = "_depth",
        depth_unit: float = 1.0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        if not depth_suffix:
            raise InputError("data.depth_suffix: empty; allowed: such as _depth")
        if not 0.0 < depth_unit < math.inf:
            raise InputError(f"data.depth_unit: {depth_unit}; allowed: mm per unit, above 0")
        self.depth_suffix, self.depth_unit = depth_suffix, float(depth_unit)

    def load_split(self, split: Split) -> FolderPhotographs:
        """Return the photographs of a split with their depths, none of them decoded yet."""
        read = partial(
            _read, suffix=self.depth_suffix, unit=self.depth_unit, megapixels=self.megapixels
        )
        return self._photographs_of(split, read)

    def _wanted(self, index: FolderIndex) -> np.ndarray:
        """Return photographs alone, each of which must have a depth map."""
        paths = {number: index.folder / name for number, name in enumerate(index.names)}
        photographs = [n for n, p in paths.items() if not is_depth_map(p, self.depth_suffix)]
        missing = [
            paths[n] for n in photographs if depth_map_of(paths[n], self.depth_suffix) is None
        ]
        if missing:
            first = missing[0]
            raise InputError(
                f"{first}: no depth map beside it (nor beside {len(missing) - 1} others); allowed: "
                f"{first.stem}{self.depth_suffix} with the ending {', '.join(ENDINGS)}"
            )
        return np.array(photographs, dtype=np.int32)


def _read(path: Path, suffix: str, unit: float, megapixels: float) -> Photograph:
    """Read a photograph and its depth map."""
    photograph = read_photograph(path, megapixels=megapixels)
    beside = depth_map_of(path, suffix)
    if beside is None:
        raise InputError(f"{path}: its depth map is no longer there")
    depth = read_depth_map(beside, unit, megapixels)
    return replace(photograph, depth=depth)


ENDINGS = (".npy", ".png", ".tif", ".tiff")
"""Endings of depth maps, in the order in which they are looked for."""


def depth_map_of(photograph: Path, suffix: str) -> Path | None:
    """Return the depth map beside a photograph: `hall.jpg` has `hall_depth.png`, for `_depth`; or
    None.
    """
    for ending in ENDINGS:
        path = photograph.with_name(f"{photograph.stem}{suffix}{ending}")
        if path.is_file():
            return path
    return None


def is_depth_map(path: Path, suffix: str) -> bool:
    """Return whether a file's name is that of a depth map."""
    return path.stem.endswith(suffix) and path.suffix.lower() in ENDINGS


def read_depth_map(path: Path, unit: float, megapixels: float = MEGAPIXELS) -> Tensor:
    """Read a depth map in mm, (height, width), float32, with holes filled.

    Numbers that are zero, negative or not finite are holes, as depth cameras leave them in the
    shadows that near things cast on far ones: each takes the largest depth on its border.

    Args:
        path: a grey image of integers or floating-point numbers, or an array that numpy saved.
        unit: mm per unit of its numbers.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, has several channels, or no depth at all.
    """
    values = read_numbers(path, megapixels=megapixels)
    if values.ndim != 2:
        raise InputError(
            f"{path}: {values.dtype} of shape {values.shape}; allowed: a depth map of one channel, "
            "integers or floating-point numbers"
        )
    depth = torch.from_numpy(values.astype(np.float32)) * unit
    known = torch.isfinite(depth) & (depth > 0.0)
    if not bool(known.any()):
        raise InputError(f"{path}: no depth above 0; allowed: at least one")
    return _filled(torch.where(known, depth, 0.0))


def _filled(depth: Tensor) -> Tensor:
    """Replace zeros by the largest depth on the border of their hole."""
    hole = depth == 0.0
    while True:
        around = max_pool2d(depth[None], 3, stride=1, padding=1)[0]
        filled = torch.where(hole, around, depth)
        if torch.equal(filled, depth):
            return depth
        depth = filled
