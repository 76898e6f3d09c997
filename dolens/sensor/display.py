"""Pictures for display are taken as light, written to files, and shown in notebooks."""

import io
import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
import torch
from PIL import Image
from torch import Tensor

from dolens.errors import InputError
from dolens.photograph_page.page import PhotographPage, ShownPhotograph
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.image_files import MEGAPIXELS
from dolens.sensor.pictures import Pixels, read_pixels

logger = logging.getLogger(__name__)

_TIFF, _PAGE = (".tif", ".tiff"), ".html"
_PNG_COLOURS = {1: 0, 3: 2}
_ROWS = 256
# Pixels along the longer side of what a notebook shows.
_SHOWN = 1024


@dataclass(frozen=True, eq=False, repr=False)
class Picture:
    """A picture that a camera gives; it shows itself in a notebook.

    Attributes:
        image: (3, H, W), sRGB values from 0 to 1.
        truth: what it stands for, likewise: the scene as an ideal lens would have imaged it.
    """

    image: Tensor
    truth: Tensor

    def save(self, path: str | Path, bits: int = 8) -> None:
        """Write the image; missing folders are created.

        Args:
            path: ends in .png, .tif or .tiff; or in .html: a page that compares it with the truth,
                by a slider and a magnifier.
            bits: 8 or 16; a page has 8.

        Raises:
            InputError: another ending, or other bits.
        """
        path = Path(path).expanduser()
        if path.suffix.lower() not in (".png", *_TIFF, _PAGE):
            raise InputError(f"{path}: allowed endings of a picture: .png, .tif, .tiff, .html")
        if bits not in (8, 16):
            raise InputError(f"bits: {bits}; allowed: 8, 16")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() == _PAGE:
            page = PhotographPage(1)
            page.add(self.shown(path.stem))
            page.write(path, path.stem, [repr(self)])
        else:
            write_picture(path, self.image, bits)

    def shown(self, name: str) -> ShownPhotograph:
        """Return it as a page has it, by a name, beside what it is compared with."""
        return ShownPhotograph(name, {"truth": self.truth, "picture": self.image})

    def __repr__(self) -> str:
        """Return the size as text."""
        height, width = self.image.shape[-2:]
        return f"{type(self).__name__} of {width}×{height} pixels"

    def _repr_png_(self) -> bytes:
        """Return the image as PNG, at most 1024 pixels along each side."""
        shown = Image.fromarray(_pixels(self.image, np.uint8))
        shown.thumbnail((_SHOWN, _SHOWN), Image.Resampling.BOX)
        buffer = io.BytesIO()
        shown.save(buffer, "PNG")
        return buffer.getvalue()


def linear_picture(
    picture: str | Path | np.ndarray | Tensor, megapixels: float = MEGAPIXELS
) -> Tensor:
    """Return the linear light of a picture, (3, H, W) float32 from 0 to 1; grey is repeated.

    What of a file is not taken as it stands is logged; see `dolens.sensor.pictures.read_pixels`.

    Args:
        picture: a file, an array (H, W, 3) or (H, W), or a tensor (3, H, W) or (H, W), of sRGB
            values: uint8, uint16, or fractions from 0 to 1.
        megapixels: the largest file that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, or it is no such array or tensor.
    """
    if isinstance(picture, str | Path):
        path = Path(picture).expanduser()
        pixels = read_pixels(path, megapixels)
        for note in pixels.notes:
            logger.warning("%s: %s", path, note)
        return pixels.linear()
    allowed = "a path, an array (H, W, 3) or (H, W), or a tensor (3, H, W) or (H, W)"
    if isinstance(picture, Tensor):
        # NumPy has no bfloat16.
        tensor = picture.detach().cpu()
        tensor = tensor.float() if tensor.is_floating_point() else tensor
        values = (tensor.permute(1, 2, 0) if tensor.ndim == 3 else tensor).numpy()
    elif isinstance(picture, np.ndarray):
        values = picture
    else:
        raise InputError(f"picture: of type {type(picture).__name__}; allowed: {allowed}")
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[-1] not in (1, 3) or 0 in values.shape:
        kind = "a tensor" if isinstance(picture, Tensor) else "an array"
        raise InputError(f"picture: {kind} of shape {tuple(picture.shape)}; allowed: {allowed}")
    if values.dtype in (np.uint8, np.uint16):
        return Pixels(np.ascontiguousarray(values)).linear()
    allowed = "sRGB values as uint8, uint16, or fractions from 0 to 1"
    if values.dtype.kind != "f":
        raise InputError(f"picture: of {values.dtype}; allowed: {allowed}")
    if not (values.min() >= 0.0 and values.max() <= 1.0):
        reach = f"{values.min():g} to {values.max():g}"
        raise InputError(f"picture: values from {reach}; allowed: {allowed}")
    encoded = torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1), np.float32))
    return srgb_to_linear(encoded).expand(3, -1, -1).contiguous()


def write_picture(path: Path, encoded: Tensor, bits: int) -> None:
    """Write a display-encoded picture as PNG or TIFF.

    Args:
        path: ends in .png, .tif or .tiff.
        encoded: (3, height, width) from 0 to 1; values outside are clipped.
        bits: 8 or 16.
    """
    pixels = _pixels(encoded, np.uint8 if bits == 8 else np.uint16)
    if path.suffix.lower() in _TIFF:
        tifffile.imwrite(path, pixels, photometric="rgb", compression="zlib")
    elif bits == 8:
        Image.fromarray(pixels).save(path)
    else:
        path.write_bytes(_png(pixels))


def _pixels(encoded: Tensor, kind: type[np.unsignedinteger]) -> np.ndarray:
    """Return (3, height, width) from 0 to 1 as whole numbers, (height, width, 3)."""
    pixels = np.empty((*encoded.shape[1:], len(encoded)), kind)
    scale = float(np.iinfo(kind).max)
    # Some rows at a time, for memory.
    for first in range(0, len(pixels), _ROWS):
        part = encoded[:, first : first + _ROWS].detach().cpu().clamp(0.0, 1.0) * scale
        pixels[first : first + _ROWS] = part.round().permute(1, 2, 0).numpy()
    return pixels


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
