"""Photographs are read from disk and kept in memory."""

import os
import stat
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from dolens.errors import InputError
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear

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

DECODING_ERRORS = (
    OSError,  # holds UnidentifiedImageError
    SyntaxError,  # a broken PNG chunk
    ValueError,
    EOFError,
    IndexError,
    KeyError,
    TypeError,
    OverflowError,
    MemoryError,
    struct.error,
    Image.DecompressionBombError,
)


@dataclass(frozen=True)
class Photograph:
    """A `Photograph` has a name, and is kept sRGB-encoded in one byte a channel to save memory.

    Attributes:
        name: how messages name it, as a rule its path.
        encoded: (3, height, width) uint8, sRGB-encoded.
        depth: (height, width) float32, mm, or None where nothing is known of it.

    Raises:
        InputError: `encoded` has another shape or dtype, or no pixels; or the depth another size.
    """

    name: str
    encoded: Tensor
    depth: Tensor | None = None

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


def probe_photograph(path: str | Path) -> str | None:
    """Read a file's header without decoding its pixels.

    Returns:
        Why Pillow cannot read the file, in one line, or None when the header is sound.  A file
        that is cut off after its header passes, and fails in `read_photograph`.
    """
    try:
        _check_regular(path)
        with Image.open(path) as image:
            image.verify()
    except DECODING_ERRORS as error:
        return reason_of(error)
    return None


def _check_regular(path: str | Path) -> None:
    """Refuse what would wait for a writer, as a pipe does."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise OSError("not a file")


def read_photograph(path: str | Path, name: str | None = None) -> Photograph:
    """Read an image file as a `Photograph`.

    The EXIF orientation is applied; greyscale is repeated in the three channels; 16-bit
    greyscale is rounded to 8 bits (Pillow itself does so for 16-bit colour); palettes, CMYK
    and the like are converted.  Transparency is composited in linear light over black, where
    nothing sends light.  Colour profiles are ignored: values are taken as sRGB.  Of several
    frames the first is read.

    Args:
        path: the file.
        name: name in messages; the path when not given.

    Raises:
        InputError: the file is missing, or cannot be decoded, or holds floating-point pixels.
    """
    name = str(path) if name is None else name
    try:
        _check_regular(path)
        with Image.open(path) as image:
            upright = ImageOps.exif_transpose(image)
            pixels = _encoded_pixels(upright, name)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{name}: no such file; allowed: an image Pillow can read") from None
    except DECODING_ERRORS as error:
        raise InputError(
            f"{name}: cannot be decoded ({reason_of(error)}); allowed: an image Pillow can read"
        ) from error
    return Photograph(name, torch.from_numpy(pixels).permute(2, 0, 1).contiguous())


def _encoded_pixels(image: Image.Image, name: str) -> np.ndarray:
    """Return the pixels (height, width, 3), uint8, sRGB-encoded."""
    if image.mode == "F":
        raise InputError(f"{name}: floating-point pixels; allowed: 8-bit or 16-bit integers")
    if image.mode.startswith("I"):
        return _from_sixteen_bits(np.asarray(image).astype(np.int64), name)
    if image.has_transparency_data:
        return _over_black(np.asarray(image.convert("RGBA")))
    return np.array(image.convert("RGB"))


def _from_sixteen_bits(grey: np.ndarray, name: str) -> np.ndarray:
    low, high = int(grey.min()), int(grey.max())
    if low < 0 or high > 65535:
        raise InputError(f"{name}: pixels from {low} to {high}; allowed: 0 to 65535")
    rounded = ((grey + 128) // 257).astype(np.uint8)
    return np.repeat(rounded[..., None], 3, axis=2)


def _over_black(colour_and_alpha: np.ndarray) -> np.ndarray:
    colour, alpha = colour_and_alpha[..., :3], colour_and_alpha[..., 3:]
    if (alpha == 255).all():
        return np.array(colour)
    linear = srgb_to_linear(torch.from_numpy(colour / np.float32(255)))
    covered = linear_to_srgb(linear * torch.from_numpy(alpha / np.float32(255)))
    return (covered * 255).round().to(torch.uint8).numpy()


def reason_of(error: BaseException) -> str:
    """Return the kind of an error and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
