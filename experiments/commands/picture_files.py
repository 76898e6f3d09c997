"""Pictures of a user's own are read as linear light, with all their bits, and written again."""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image
from torch import Tensor

from dolens.errors import InputError
from dolens.sensor.image_files import MEGAPIXELS, read_numbers
from dolens.sensor.pictures import read_pixels

_TIFF = (".tif", ".tiff")
_PNG_COLOURS = {1: 0, 3: 2}
_ROWS = 256


@dataclass(frozen=True)
class Picture:
    """A picture as a scene: what light comes from it.

    Attributes:
        name: of the file, without its ending.
        linear: (3, height, width) float32, linear light in [0, 1].
        bits: of each value in the file, 8 or 16.
        notes: what of the file was not taken as it stands, a sentence each.
    """

    name: str
    linear: Tensor
    bits: int
    notes: tuple[str, ...] = ()


def read_picture(path: str | Path, megapixels: float = MEGAPIXELS) -> Picture:
    """Read a picture of 8 or 16 bits as the training's photographs are read.

    See `dolens.sensor.pictures.read_pixels`; grey is repeated in the three channels; transparency
    is composited in linear light over black, where nothing sends light.

    Args:
        path: BMP, GIF, JPEG, PNG, PPM, TIFF or WebP.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file is missing, broken, too large, or holds what has no meaning here.
    """
    path = Path(path).expanduser()
    pixels = read_pixels(path, megapixels)
    return Picture(path.stem, pixels.linear(), pixels.bits, pixels.notes)


def read_array(path: str | Path, megapixels: float = MEGAPIXELS) -> np.ndarray:
    """Read what a sensor gave, as finite numbers: (height, width), or (height, width, channels).

    See `dolens.sensor.image_files.read_numbers`.

    Raises:
        InputError: the file cannot be read as such numbers.
    """
    path = Path(path).expanduser()
    found = read_numbers(path, megapixels=megapixels)
    if not np.isfinite(found).all():
        raise InputError(f"{path}: some values are not finite")
    return found


def write_picture(path: Path, encoded: Tensor, bits: int) -> None:
    """Write a display-encoded picture as PNG or TIFF.

    Args:
        path: ends in .png, .tif or .tiff.
        encoded: (3, height, width) from 0 to 1; values outside are clipped.
        bits: 8 or 16.
    """
    scale, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    pixels = np.empty((*encoded.shape[1:], len(encoded)), kind)
    # Some rows at a time, for memory.
    for first in range(0, len(pixels), _ROWS):
        part = encoded[:, first : first + _ROWS].detach().cpu().clamp(0.0, 1.0) * scale
        pixels[first : first + _ROWS] = part.round().permute(1, 2, 0).numpy()
    if path.suffix.lower() in _TIFF:
        tifffile.imwrite(path, pixels, photometric="rgb", compression="zlib")
    elif bits == 8:
        Image.fromarray(pixels).save(path)
    else:
        path.write_bytes(_png(pixels))


def _png(pixels: np.ndarray) -> bytes:
    """Return a PNG file of 16 bits a value, which Pillow does not write in colour."""
    height, width, channels = pixels.shape
    rows = np.ascontiguousarray(pixels.astype(">u2")).view(np.uint8).reshape(height, -1)
    # Differences to the row above (filter 2) are shorter than the values.
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), rows - above])
    header = struct.pack(">IIBBBBB", width, height, 16, _PNG_COLOURS[channels], 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 6)), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
