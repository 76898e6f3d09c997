"""Pictures of a user's own are read as linear light, with all their bits, and written again."""

import io
import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
import torch
from PIL import Image, ImageCms
from torch import Tensor
from torchvision.io import ImageReadMode, decode_image

from dolens.errors import InputError
from dolens.experiments.data.photographs import DECODING_ERRORS, read_photograph, reason_of
from dolens.sensor.colour import srgb_to_linear

_TIFF = (".tif", ".tiff")
_ORIENTATION = 274
# What Pillow does for each EXIF orientation; 1 is upright.
_TURNS = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
_PNG_COLOURS = {1: 0, 3: 2}


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


def read_picture(path: str | Path) -> Picture:
    """Read a picture of 8 or 16 bits as the training's photographs are read.

    Values are sRGB-encoded, whatever a colour profile says; the EXIF orientation is applied; grey
    is repeated in the three channels; transparency is composited in linear light over black, where
    nothing sends light.

    Args:
        path: PNG, TIFF, JPEG, or another format that Pillow reads.

    Raises:
        InputError: the file is missing, is no such image, or holds floating-point pixels.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise InputError(f"{path}: no such file; allowed: an image Pillow can read")
    notes = _profile_note(path)
    deep = _sixteen_bits(path)
    if deep is None:
        with warnings.catch_warnings():  # of very large pictures; the command says what they take
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            encoded = read_photograph(path).encoded
        return Picture(path.stem, srgb_to_linear(encoded.float() / 255.0), 8, notes)
    values = srgb_to_linear(torch.from_numpy(deep[..., :3] / np.float32(65535)))
    if deep.shape[-1] in (2, 4):
        values = srgb_to_linear(torch.from_numpy(deep[..., :-1] / np.float32(65535)))
        values = values * torch.from_numpy(deep[..., -1:] / np.float32(65535))
    linear = values.permute(2, 0, 1).expand(3, -1, -1).contiguous()
    return Picture(path.stem, linear, 16, notes)


def _profile_note(path: Path) -> tuple[str, ...]:
    """A sentence where an embedded colour profile is none of sRGB."""
    try:
        with Image.open(path) as image:
            profile = image.info.get("icc_profile")
            if not profile:
                return ()
            name = ImageCms.getProfileDescription(
                ImageCms.ImageCmsProfile(io.BytesIO(profile))
            ).strip()
    except (*DECODING_ERRORS, ImageCms.PyCMSError):
        return ()
    if "srgb" in name.lower():
        return ()
    return (f"its colour profile, {name or 'unnamed'}, is ignored: values are taken as sRGB",)


def _sixteen_bits(path: Path) -> np.ndarray | None:
    """Pixels (height, width, channels), upright, float32 from 0 to 65535; None: of fewer bits.

    Pillow itself gives 8 of 16 bits of a colour.

    Raises:
        InputError: a TIFF file that is no image of whole numbers.
    """
    try:
        if path.suffix.lower() in _TIFF:
            return _deep_tiff(path)
        with Image.open(path) as image:
            kind, orientation = image.format, image.getexif().get(_ORIENTATION, 1)
        if kind == "TIFF":
            return _deep_tiff(path)
        with path.open("rb") as file:
            header = file.read(25)
        if kind != "PNG" or header[24] != 16:
            return None
        data = torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8)
        found = decode_image(data, ImageReadMode.UNCHANGED)
        pixels = found.permute(1, 2, 0).numpy().astype(np.float32)
    except InputError:
        raise
    except (*DECODING_ERRORS, RuntimeError, tifffile.TiffFileError) as error:
        raise InputError(
            f"{path}: cannot be decoded ({reason_of(error)}); allowed: an image Pillow can read"
        ) from None
    return _upright(pixels, orientation)


def _deep_tiff(path: Path) -> np.ndarray | None:
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        if page.dtype is None or page.dtype.itemsize == 1:
            return None  # Pillow reads these, in all compressions
        if page.dtype != np.uint16:
            raise InputError(f"{path}: {page.dtype} pixels; allowed: 8-bit or 16-bit integers")
        pixels = page.asarray()
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
            pixels = np.moveaxis(pixels, 0, -1)
        tag = page.tags.get("Orientation")
        white_is_zero = page.photometric == tifffile.PHOTOMETRIC.MINISWHITE
    pixels = pixels.astype(np.float32)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.shape[-1] > 4:
        raise InputError(f"{path}: pixels of shape {pixels.shape}; allowed: grey, RGB, RGBA")
    return _upright(65535 - pixels if white_is_zero else pixels, tag.value if tag else 1)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    return np.ascontiguousarray(_TURNS.get(int(orientation), lambda a: a)(pixels))


def read_array(path: str | Path) -> np.ndarray:
    """Read what a sensor gave, as numbers: (height, width), or (height, width, channels).

    Nothing is decoded, turned or converted.

    Args:
        path: `.npy`, or PNG or TIFF of 8 or 16 bits.

    Raises:
        InputError: the file is missing or is none of these.
    """
    path = Path(path).expanduser()
    allowed = "allowed: .npy, or PNG or TIFF of 8 or 16 bits"
    if not path.is_file():
        raise InputError(f"{path}: no such file; {allowed}")
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy":
            found = np.load(path, allow_pickle=False)
        elif suffix in _TIFF:
            found = tifffile.imread(path, key=0)
        elif suffix == ".png":
            data = torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8)
            found = decode_image(data, ImageReadMode.UNCHANGED).permute(1, 2, 0).numpy()
        else:
            raise InputError(f"{path}: raw values cannot be read from {suffix or 'it'}; {allowed}")
    except InputError:
        raise
    except (*DECODING_ERRORS, RuntimeError, tifffile.TiffFileError) as error:
        raise InputError(f"{path}: cannot be decoded ({reason_of(error)}); {allowed}") from None
    if found.ndim == 3 and found.shape[-1] == 1:
        found = found[..., 0]
    kind = found.dtype.kind
    if found.ndim not in (2, 3) or kind not in "uif":
        raise InputError(f"{path}: {found.dtype} of shape {found.shape}; allowed: numbers (height, "
                         "width), or (height, width, 3)")  # fmt: skip
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
    values = (encoded.detach().cpu().clamp(0.0, 1.0) * scale).round().permute(1, 2, 0)
    pixels = values.numpy().astype(kind)
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
