"""Image files are opened by their content, within a limit of pixels, and raw ones are read.

A file's content, not its name, says which format it is.  Its size is checked before anything is
decoded, so that a small file cannot ask for much memory.
"""

import math
import os
import stat
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import (
    BmpImagePlugin,
    GifImagePlugin,
    Image,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from dolens.errors import InputError

MEGAPIXELS = 64.0
"""The largest image that is read unless a setting says otherwise, millions of pixels."""

FORMATS = "BMP, GIF, JPEG, PNG, PPM, TIFF, WebP"
"""The formats that are read."""

# What a file begins with, its format, and Pillow's reader of it.  Image.open tries every format
# that Pillow knows, PostScript among them, for which it starts another program.
_OPENERS: tuple[tuple[tuple[bytes, ...], str, Callable[..., Any]], ...] = (
    ((b"\x89PNG\r\n\x1a\n",), "PNG", PngImagePlugin.PngImageFile),
    ((b"\xff\xd8\xff",), "JPEG", JpegImagePlugin.jpeg_factory),
    ((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF", TiffImagePlugin.TiffImageFile),
    ((b"GIF87a", b"GIF89a"), "GIF", GifImagePlugin.GifImageFile),
    ((b"RIFF",), "WebP", WebPImagePlugin.WebPImageFile),
    ((b"BM",), "BMP", BmpImagePlugin.BmpImageFile),
    ((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), "PPM", PpmImagePlugin.PpmImageFile),
)
_NUMPY = b"\x93NUMPY"
# Compressions of TIFF that tifffile undoes by itself: none, Deflate (two numbers) and PackBits.
_DEFLATE = (8, 32946)
PLAIN = (1, *_DEFLATE, 32773)
"""Numbers of the TIFF compressions whose samples `tiff_samples` gives."""
# PNG chunks that say what values mean; none is longer than 64 bytes, profiles aside.
_PNG_CHUNKS = (b"IHDR", b"gAMA", b"sRGB", b"iCCP", b"cICP", b"tRNS")


def format_of(path: str | Path) -> str:
    """Return the format of a file by its content: one of `FORMATS`, or `.npy`.

    Raises:
        InputError: there is no such file, it is no regular file (a pipe, a device, a folder), it
            cannot be opened, or it has another format.
    """
    try:
        regular = stat.S_ISREG(os.stat(path).st_mode)
        begin = b""
        if regular:
            with open(path, "rb") as file:
                begin = file.read(16)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; allowed: an image of {FORMATS}") from None
    except (OSError, ValueError) as error:  # of a name that no file can have too
        raise InputError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from None
    if not regular:
        raise InputError(f"{path}: is no file; allowed: an image of {FORMATS}")
    if begin.startswith(_NUMPY):
        return ".npy"
    for starts, kind, _ in _OPENERS:
        if begin.startswith(starts) and (kind != "WebP" or begin[8:12] == b"WEBP"):
            return kind
    raise InputError(f"{path}: cannot be decoded (no image of these); allowed: {FORMATS}")


@contextmanager
def opened_image(path: str | Path, megapixels: float = MEGAPIXELS) -> Iterator[Image.Image]:
    """Open an image with Pillow; nothing is decoded before its size is known to be allowed.

    Args:
        path: of one of `FORMATS`.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file is missing, is none of these formats, is too large, or Pillow cannot
            read it.
    """
    kind = format_of(path)
    if kind == ".npy":
        raise InputError(f"{path}: is no image of these formats; allowed: {FORMATS}")
    opener = next(opener for _, name, opener in _OPENERS if name == kind)
    with decoding(path, kind), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what Pillow passes over
        with open(path, "rb") as file, opener(file, os.fspath(path)) as image:
            check_size(path, image.height, image.width, megapixels)
            yield image


@contextmanager
def decoding(path: str | Path, kind: str) -> Iterator[None]:
    """Turn whatever a decoder makes of a broken file into one line that names it."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{path}: cannot be decoded as {kind} ({reason_of(error)}); allowed: an image of "
            f"{FORMATS}"
        ) from error


def reason_of(error: BaseException) -> str:
    """Return the kind of an error and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def check_size(path: str | Path, height: int, width: int, megapixels: float) -> None:
    """Refuse an image with more pixels than are allowed, or with none.

    Raises:
        InputError: it has; or `megapixels` is not above 0.
    """
    if not megapixels > 0.0:
        raise InputError(f"megapixels: {megapixels}; allowed: above 0")
    if height < 1 or width < 1:
        raise InputError(f"{path}: {width}×{height} pixels; allowed: one or more")
    if height * width > megapixels * 1e6:
        millions = round(height * width / 1e6, 1)
        raise InputError(
            f"{path}: {width}×{height} are {millions:g} million pixels; allowed: up to "
            f"{megapixels:g}, the setting megapixels"
        )


def png_meaning(path: str | Path) -> dict[bytes, bytes]:
    """Return the chunks before the pixels that say what values mean, by their names."""
    found: dict[bytes, bytes] = {}
    with decoding(path, "PNG"), open(path, "rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            (length,), name = struct.unpack(">I", head[:4]), head[4:]
            data = file.read(min(length, 64)) if name in _PNG_CHUNKS else b""
            if name in _PNG_CHUNKS:
                found.setdefault(name, data)
            file.seek(length - len(data) + 4, os.SEEK_CUR)
        if len(found.get(b"IHDR", b"")) != 13:
            raise SyntaxError("no header")
    return found


def deep_png(path: str | Path, image: Image.Image) -> np.ndarray:
    """Return pixels of 16 bits, (height, width, 1 to 4) uint16; in colour Pillow gives 8."""
    if image.mode.startswith("I"):
        return np.asarray(image).astype(np.uint16)[..., None]
    from torchvision.io import ImageReadMode, decode_image

    data = torch.from_numpy(np.memmap(path, np.uint8, "c"))
    return decode_image(data, ImageReadMode.UNCHANGED).permute(1, 2, 0).numpy()


@contextmanager
def tiff_page(path: str | Path, megapixels: float) -> Iterator[Any]:
    """Open a TIFF file's first image, whose size is allowed."""
    import tifffile

    with decoding(path, "TIFF"), tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        check_size(path, page.imagelength, page.imagewidth, megapixels)
        if page.samplesperpixel > 16 or page.imagedepth != 1:
            raise InputError(
                f"{path}: {page.samplesperpixel} samples of {page.imagedepth} slices; allowed: "
                "grey, RGB or CMYK, with or without alpha"
            )
        yield page


def tiff_words(page: Any) -> str:
    """Return what a TIFF page holds, in words: `CIELAB of 16 bits`."""
    name = getattr(page.photometric, "name", page.photometric)
    return f"{name} of {page.bitspersample} bits, {page.samplesperpixel} samples"


def tiff_samples(path: str | Path, page: Any) -> np.ndarray:
    """Return a page's samples, (height, width, samples), as they stand.

    Raises:
        InputError: parts are missing, or unpack to more than they say.
    """
    shape = (page.imagelength, page.imagewidth, page.samplesperpixel)
    item = np.dtype(page.dtype).itemsize
    if not all(page.databytecounts) or len(page.databytecounts) != len(page.dataoffsets):
        raise InputError(f"{path}: some of its pixels are missing")
    if int(page.compression) in _DEFLATE:
        # At most a whole row or column of tiles more than the image.
        part = max(1, math.prod(page.chunks)) * item
        for segment, _ in page.parent.filehandle.read_segments(
            page.dataoffsets, page.databytecounts
        ):
            unpacked = zlib.decompressobj()
            unpacked.decompress(segment or b"", part)
            if unpacked.unconsumed_tail and unpacked.decompress(unpacked.unconsumed_tail, 1):
                raise InputError(f"{path}: unpacks to more than its {shape[1]}×{shape[0]} pixels")
    pixels = page.asarray()
    if int(page.planarconfig) == 2 and pixels.ndim == 3:
        pixels = np.moveaxis(pixels, 0, -1)
    return pixels.reshape(shape)


def read_numbers(
    path: str | Path, kinds: Sequence[str] = (".npy", "PNG", "TIFF"), megapixels: float = MEGAPIXELS
) -> np.ndarray:
    """Read numbers as a file holds them: what a sensor gave, or depths.

    Nothing is decoded, turned, scaled or converted.

    Args:
        path: an array that numpy saved, or PNG or TIFF.
        kinds: of these, which are allowed.
        megapixels: the largest that is read, millions of pixels.

    Returns:
        (height, width), or (height, width, channels): integers or floating-point numbers.

    Raises:
        InputError: the file is missing, broken or too large, or its values are no such numbers: a
            palette's, of fewer than 8 bits, inks, or with white as zero.
    """
    kind = format_of(path)
    allowed = f"allowed: {', '.join(kinds)} of grey or RGB numbers"
    if kind not in kinds:
        raise InputError(f"{path}: raw values cannot be read from {kind}; {allowed}")
    if kind == ".npy":
        with decoding(path, kind):
            found: np.ndarray = np.lib.format.open_memmap(path, mode="r")
            if found.ndim not in (2, 3) or found.dtype.kind not in "uif":
                raise InputError(
                    f"{path}: {found.dtype} of shape {found.shape}; allowed: numbers (height, "
                    "width), or (height, width, 3)"
                )
            check_size(path, found.shape[0], found.shape[1], megapixels)
            found = np.array(found)
    elif kind == "PNG":
        header = png_meaning(path)[b"IHDR"]
        if header[8] < 8 or header[9] == 3:
            what = "a palette's colours" if header[9] == 3 else f"{header[8]} bits"
            raise InputError(f"{path}: {what} in the place of numbers; {allowed}")
        with opened_image(path, megapixels) as image:
            found = deep_png(path, image) if header[8] == 16 else np.array(image)
    else:
        found = _tiff_numbers(path, megapixels, allowed)
    if found.ndim == 3 and found.shape[-1] == 1:
        found = found[..., 0]
    return found


def _tiff_numbers(path: str | Path, megapixels: float, allowed: str) -> np.ndarray:
    with tiff_page(path, megapixels) as page:
        # Black is zero, RGB, or the numbers of colour filters.
        if int(page.photometric) not in (1, 2, 32803, 34892) or page.dtype is None:
            raise InputError(f"{path}: {tiff_words(page)} in the place of numbers; {allowed}")
        whole = np.dtype(page.dtype).itemsize * 8 == page.bitspersample
        if not whole or np.dtype(page.dtype).kind not in "uif":
            raise InputError(f"{path}: {tiff_words(page)} in the place of numbers; {allowed}")
        if int(page.compression) in PLAIN:
            return tiff_samples(path, page)
        with opened_image(path, megapixels) as image:
            found = np.array(image)
        if found.dtype.itemsize != np.dtype(page.dtype).itemsize:
            raise InputError(
                f"{path}: {tiff_words(page)}, {page.compression.name} compression; allowed: "
                "none, or Deflate"
            )
        return found
