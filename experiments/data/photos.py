"""Photographs are read from the installed scikit-image."""

import difflib
import importlib.metadata
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule, Split
from dolens.experiments.data.photographs import EXTENSIONS, Photograph, read_photograph

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
