"""Photographs are read from any folder of images."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule, Split
from dolens.experiments.data.folder_photographs import FolderPhotographs
from dolens.experiments.data.photographs import (
    EXTENSIONS,
    list_photographs,
    normalised_extensions,
    probe_photograph,
)

_log = logging.getLogger(__name__)


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
        verify: look at every file's header at set-up and leave out those that are no images.
            False leaves it to decoding, where the next readable file takes the place of an
            unreadable one: what to choose for very many files.
        cache_bytes: decoded pixels kept in memory, in each split and process.

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
        self.root = Path(root).expanduser()
        self.extensions = normalised_extensions(extensions)
        self.validation_fraction = validation_fraction
        self.test_fraction = test_fraction
        self.evaluation_limit = evaluation_limit
        self.verify = verify
        self.cache_bytes = cache_bytes
        self._paths: dict[Split, list[Path]] | None = None
        self._refused: dict[Path, None] = {}

    @property
    def skipped_files(self) -> list[Path]:
        """Return the files left out or replaced so far because they cannot be read, sorted."""
        found = set(self._refused)
        for photographs in self._photographs.values():
            if isinstance(photographs, FolderPhotographs):
                found.update(photographs.unreadable)
        return sorted(found)

    @property
    def paths(self) -> dict[Split, list[Path]]:
        """Return the files of each split, listed (and verified, if asked for) at the first call.

        Raises:
            InputError: as at set-up.
        """
        if self._paths is None:
            self._paths = self._listed()
        return self._paths

    def load_split(self, split: Split) -> FolderPhotographs:
        """Return the photographs of a split, none of them decoded yet."""
        return FolderPhotographs(self.root, self.paths[split], self.cache_bytes)

    def teardown(self, stage: str) -> None:
        """Report how many files could not be read."""
        skipped = self.skipped_files
        if skipped and self._paths is not None:
            total = sum(len(paths) for paths in self._paths.values()) + len(self._refused)
            _log.warning("skipped %d unreadable files of %d in %s", len(skipped), total, self.root)

    def _listed(self) -> dict[Split, list[Path]]:
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

    def _list(self, folder: Path) -> list[Path]:
        """List the files under a folder, without those whose header Pillow refuses."""
        paths = self._listed_files(folder)
        if not self.verify:
            return paths
        readable: list[Path] = []
        for path in paths:
            reason = probe_photograph(path)
            if reason is None:
                readable.append(path)
            else:
                self._refused[path] = None
                _log.warning("%s: not a readable image (%s); skipped", path, reason)
        skipped = len(paths) - len(readable)
        if not readable:
            raise InputError(
                f"{folder}: none of {skipped} files is a readable image; allowed: images ending "
                f"in {', '.join(self.extensions)}"
            )
        if skipped:
            _log.warning("skipped %d unreadable files of %d in %s", skipped, len(paths), folder)
        return readable

    def _listed_files(self, folder: Path) -> list[Path]:
        """List the photographs' files under a folder; none is opened."""
        return list_photographs(folder, self.extensions)

    def _divided(self, paths: list[Path], bounds: list[float]) -> list[list[Path]]:
        """Divide the files by their hashes at each bound; no part is empty."""
        if len(paths) <= len(bounds):
            raise InputError(
                f"{self.root}: {len(paths)} readable images for {len(bounds) + 1} splits; "
                "allowed: at least one for each"
            )
        hashed = sorted((self._hash(path), path) for path in paths)
        parts: list[list[Path]] = []
        begin = 0
        for position, bound in enumerate(bounds):
            end = sum(value < bound for value, _ in hashed)
            end = max(end, begin + 1)
            end = min(end, len(hashed) - (len(bounds) - position))
            parts.append(sorted(path for _, path in hashed[begin:end]))
            begin = end
        parts.append(sorted(path for _, path in hashed[begin:]))
        return parts

    def _limited(self, paths: list[Path]) -> list[Path]:
        if self.evaluation_limit is None or len(paths) <= self.evaluation_limit:
            return paths
        return sorted(sorted(paths, key=self._hash)[: self.evaluation_limit])

    def _hash(self, path: Path) -> float:
        """Return a number in [0, 1) from the seed and the path below the root."""
        text = f"{self.seed}:{path.relative_to(self.root).as_posix()}"
        digest = hashlib.blake2b(text.encode("utf-8", "surrogateescape"), digest_size=8).digest()
        return int.from_bytes(digest, "big") / 2**64
