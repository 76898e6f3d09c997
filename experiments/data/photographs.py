"""Photographs are read from disk and kept in memory."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dolens.errors import InputError
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
