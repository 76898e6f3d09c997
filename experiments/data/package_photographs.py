"""Photographs of installed packages are found by path, and verified by hash."""

import difflib
import hashlib
import importlib.metadata
import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import torch
from torch.nn.functional import avg_pool2d

from dolens.errors import InputError, check_count
from dolens.experiments.data.camera_data import CropDataModule, Split
from dolens.experiments.data.crops import linear_light
from dolens.experiments.data.photographs import EXTENSIONS, Photograph, read_photograph
from dolens.experiments.tables import read_table
from dolens.sensor.colour import linear_to_srgb

TRAIN: tuple[str, ...] = (
    "astronaut.png",
    "camera.png",
    "motorcycle_left.png",
    "motorcycle_right.png",
    "brick.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "moon.png",
    "retina.jpg",
)
VALIDATION: tuple[str, ...] = ("rocket.jpg", "grass.png")
TEST: tuple[str, ...] = ("coffee.png", "chelsea.png", "coins.png")

_STEREO_PAIR = ("motorcycle_left.png", "motorcycle_right.png")


class PhotosDataModule(CropDataModule):
    """`PhotosDataModule` cuts crops of the photographs inside the installed scikit-image; nothing
    is downloaded.

    Args:
        train: names of the photographs to train on.
        validation: names of the photographs to validate on.
        test: names of the photographs to test on.
        **crops: the arguments of `CropDataModule`.

    Raises:
        InputError: a split is empty, a name is unknown or stands twice, or the stereo pair is
            split; at set-up, a photograph is missing from the installed scikit-image.
    """

    def __init__(
        self,
        train: Sequence[str] = TRAIN,
        validation: Sequence[str] = VALIDATION,
        test: Sequence[str] = TEST,
        **crops: Any,
    ) -> None:
        super().__init__(**crops)
        self.names: dict[Split, tuple[str, ...]] = {
            "train": _names("train", train),
            "validation": _names("validation", validation),
            "test": _names("test", test),
        }
        _check_splits(self.names)

    def load_split(self, split: Split) -> list[Photograph]:
        """Read the photographs of a split into memory, one byte a channel."""
        return [read_installed(name) for name in self.names[split]]


def photographs_folder() -> Path:
    """Return the folder in which the installed scikit-image keeps its images.

    Raises:
        InputError: scikit-image is not installed.
    """
    spec = importlib.util.find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        raise InputError("data: scikit-image is not installed; allowed: scikit-image>=0.25")
    return Path(spec.submodule_search_locations[0]) / "data"


def read_installed(name: str) -> Photograph:
    """Read one photograph of the installed scikit-image by its file name.

    Raises:
        InputError: the file is missing or unreadable; the line names it and the version.
    """
    path = photographs_folder() / name
    version = importlib.metadata.version("scikit-image")
    if not path.is_file():
        raise InputError(
            f"{path}: missing from scikit-image {version}; allowed: an installation with its "
            "images, or other names in data.train, data.validation and data.test"
        )
    return read_photograph(path, name)


def _names(split: Split, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str) or len(names) == 0:
        raise InputError(f"data.{split}: {names!r}; allowed: a list of names, at least one")
    return tuple(str(name) for name in names)


def _check_splits(names: dict[Split, tuple[str, ...]]) -> None:
    allowed = _known_names()
    split_of: dict[str, Split] = {}
    for split, of_split in names.items():
        for name in of_split:
            if name not in allowed:
                nearest = difflib.get_close_matches(name, sorted(allowed), n=1, cutoff=0.0)
                raise InputError(
                    f"data.{split}: no photograph {name!r} in scikit-image; did you mean "
                    f"{nearest[0]!r}? allowed: {', '.join(sorted(allowed))}"
                )
            if name in split_of:
                raise InputError(
                    f"data.{split}: {name!r} stands in {split_of[name]} already; allowed: "
                    "each photograph once, in one split"
                )
            split_of[name] = split
    left, right = (split_of.get(name) for name in _STEREO_PAIR)
    if left is not None and right is not None and left != right:
        raise InputError(
            f"data.{right}: {_STEREO_PAIR[1]!r} shows the scene of {_STEREO_PAIR[0]!r} in "
            f"{left}; allowed: both in one split"
        )


def _known_names() -> set[str]:
    folder = photographs_folder()
    installed = (
        {path.name for path in folder.iterdir() if path.suffix.lower() in EXTENSIONS}
        if folder.is_dir()
        else set()
    )
    return installed | {*TRAIN, *VALIDATION, *TEST}


MANIFEST = Path(__file__).with_suffix(".csv")
"""The project's own list; its columns are those of `Entry`."""

_COLUMNS = ("split", "package", "version", "path", "sha256", "title")

# What XDG_DATA_DIRS means where it is not set, by the XDG Base Directory Specification.
_XDG_DEFAULT = "/usr/local/share/:/usr/share/"


@dataclass(frozen=True, kw_only=True)
class PackagedPhotograph:
    """A `PackagedPhotograph` is a photograph that a package brings.

    Attributes:
        package: the Debian package that brings it.
        version: of the package, where the file was taken from.
        path: of the file, relative to a folder of shared data.
        sha256: of the photograph's bytes, hexadecimal.
    """

    package: str
    version: str
    path: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Entry(PackagedPhotograph):
    """An `Entry` is a photograph of a manifest, in a file of its own.

    Attributes:
        split: `train`, `validation` or `test`.
        title: a few words on what it shows.
    """

    split: Split
    title: str


class PackagePhotographsDataModule(CropDataModule):
    """`PackagePhotographsDataModule` cuts crops of photographs that installed packages bring;
    nothing is downloaded.

    A manifest names the files with their hashes and says which split each belongs to.  A file is
    taken from the first folder that has it.  Training besides sees photographs of scikit-image;
    validation and test do not.

    Args:
        manifest: a CSV file with the columns split, package, version, path, sha256, title; None:
            the project's own.
        folders: folders of shared data to search, in order (packages unpacked by hand have one in
            `usr/share`); None: those of the environment's XDG_DATA_DIRS.
        shrink_to: photographs are averaged over k×k pixels in linear light, with the largest whole
            k that leaves the longer side at least this long; pixels of large photographs are soft.
        scikit_image: names of scikit-image's photographs to train on besides.
        **crops: the arguments of `CropDataModule`.

    Raises:
        InputError: the manifest is not readable as such, or lists a file twice; at set-up, a file
            is missing or altered (the line names it and its package).
    """

    def __init__(
        self,
        manifest: str | None = None,
        folders: Sequence[str] | None = None,
        shrink_to: int = 1280,
        scikit_image: Sequence[str] = TRAIN,
        **crops: Any,
    ) -> None:
        super().__init__(**crops)
        self.entries = read_manifest(MANIFEST if manifest is None else Path(manifest))
        self.folders = data_folders() if folders is None else [Path(f) for f in folders]
        check_count("data.shrink_to", shrink_to)
        self.shrink_to = shrink_to
        self.scikit_image = tuple(scikit_image)

    def load_split(self, split: Split) -> list[Photograph]:
        """Find all files of a split, check them, and read them, one byte a channel."""
        entries = [entry for entry in self.entries if entry.split == split]
        files = find_files(entries, self.folders)
        found = [
            shrunk(read_photograph(file, entry.path), self.shrink_to)
            for entry, file in zip(entries, files, strict=True)
        ]
        besides = self.scikit_image if split == "train" else ()
        return found + [read_installed(name) for name in besides]


def data_folders() -> list[Path]:
    """Return the folders of shared data that the environment's XDG_DATA_DIRS names, in its
    order.
    """
    named = os.environ.get("XDG_DATA_DIRS", "") or _XDG_DEFAULT
    return [Path(folder) for folder in named.split(os.pathsep) if folder]


def read_manifest(path: Path) -> list[Entry]:
    """Read a manifest of photographs.

    Raises:
        InputError: the file is missing, has other columns, an unknown split, a path that leaves the
            folder, a path or hash that stands twice, or a split without photographs.
    """
    if not os.path.lexists(path):
        raise InputError(f"data.manifest: {path} does not exist")
    rows = read_table(path, _COLUMNS)
    entries = [_entry(path, line, row) for line, row in enumerate(rows, start=2)]
    for name in ("path", "sha256"):
        seen: set[str] = set()
        for line, entry in enumerate(entries, start=2):
            value = getattr(entry, name)
            if value in seen:
                raise InputError(f"{path}, line {line}: {name} {value} stands twice")
            seen.add(value)
    for split in get_args(Split):
        if not any(entry.split == split for entry in entries):
            raise InputError(f"{path}: no photographs to {split}; allowed: one or more")
    return entries


def find_files(entries: Sequence[Entry], folders: Sequence[Path]) -> list[Path]:
    """Find the files of entries, each in the first folder that has it, and verify their hashes.

    Raises:
        InputError: files are missing, or one is not the file that was listed.
    """
    files = locate(entries, folders)
    for entry, file in zip(entries, files, strict=True):
        with file.open("rb") as content:
            check_hash(entry, file, hashlib.file_digest(content, "sha256").hexdigest())
    return files


def locate(entries: Sequence[PackagedPhotograph], folders: Sequence[Path]) -> list[Path]:
    """Find the files that hold photographs, each in the first folder that has it.

    Raises:
        InputError: files are missing; the line names the packages that bring them.
    """
    files = [_first(entry, folders) for entry in entries]
    missing = [entry for entry, file in zip(entries, files, strict=True) if file is None]
    if missing:
        packages = sorted({entry.package for entry in missing})
        raise InputError(
            f"{missing[0].path}: missing (with {len(missing) - 1} other photographs) from "
            f"{', '.join(map(str, folders))}; install the Debian packages {' '.join(packages)}, or "
            "unpack them and name their usr/share in data.folders"
        )
    return [file for file in files if file is not None]


def check_hash(entry: PackagedPhotograph, file: Path, sha256: str) -> None:
    """Check that the bytes found in a file have the hash that is listed.

    Raises:
        InputError: they have another.
    """
    if sha256 != entry.sha256:
        raise InputError(
            f"{file}: not the file that the manifest lists (SHA-256 differs); install the "
            f"Debian package {entry.package}, version {entry.version}"
        )


def shrunk(photograph: Photograph, least: int) -> Photograph:
    """Average a photograph over k×k pixels in linear light; see `averaged`.

    Args:
        photograph: without depth.
        least: pixels that the longer side keeps; k is the largest whole number that leaves them.
    """
    return averaged(photograph, max(photograph.height, photograph.width) // least)


def averaged(photograph: Photograph, factor: int) -> Photograph:
    """Average a photograph over factor×factor pixels in linear light; incomplete last rows and
    columns are dropped.

    Args:
        photograph: without depth; it is returned as it is where it is smaller than that.
        factor: pixels of the photograph to a pixel of the average, along each side.
    """
    if factor <= 1 or min(photograph.height, photograph.width) < factor:
        return photograph
    light = torch.cat([avg_pool2d(linear_light(band[None]), factor) for band in photograph.encoded])
    encoded = (linear_to_srgb(light) * 255.0).round().to(torch.uint8)
    return Photograph(photograph.name, encoded)


def check_inside(manifest: Path, line: int, path: str) -> None:
    """Check that a path of a manifest stays within a folder.

    Raises:
        InputError: it is absolute, empty, or goes up.
    """
    inside = PurePosixPath(path)
    if inside.is_absolute() or ".." in inside.parts or not inside.parts:
        raise InputError(
            f"{manifest}, line {line}: path '{path}'; allowed: one within a folder of shared data"
        )


def _entry(path: Path, line: int, row: dict[str, str]) -> Entry:
    if row.keys() != set(_COLUMNS) or None in row.values():
        raise InputError(f"{path}, line {line}: {len(_COLUMNS)} values are needed")
    entry = Entry(**row)
    if entry.split not in get_args(Split):
        raise InputError(
            f"{path}, line {line}: split '{entry.split}'; allowed: {', '.join(get_args(Split))}"
        )
    check_inside(path, line, entry.path)
    return entry


def _first(entry: PackagedPhotograph, folders: Sequence[Path]) -> Path | None:
    return next((f / entry.path for f in folders if os.path.isfile(f / entry.path)), None)
