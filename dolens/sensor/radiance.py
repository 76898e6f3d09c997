"""Pictures that hold radiance beyond white are read as linear light."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.sensor.display import linear_picture
from dolens.sensor.image_files import (
    MEGAPIXELS,
    check_size,
    decoding,
    format_of,
    read_numbers,
    tiff_page,
)

_MOST_HEADER = 1 << 14
_SIGNATURES = (b"#?RADIANCE", b"#?RGBE")


def radiance_picture(
    picture: str | Path | np.ndarray | Tensor, megapixels: float = MEGAPIXELS
) -> Tensor:
    """Return the linear light of a picture, (3, H, W) float32, 1 for white, which may be more.

    Floating-point numbers are linear light as they stand.  Whole numbers are sRGB values as in
    `dolens.sensor.display.linear_picture`, and hold no more than white.

    Args:
        picture: a file of Radiance (.hdr), a floating-point TIFF or .npy, or any other picture; an
            array (H, W, 3) or (H, W), or a tensor (3, H, W) or (H, W).
        megapixels: the largest file that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, or it is no such array or tensor.
    """
    if isinstance(picture, str | Path):
        path = Path(picture).expanduser()
        if path.suffix.lower() == ".exr":
            raise InputError(f"{path}: OpenEXR is not read; allowed: .hdr, TIFF or .npy of floats")
        if path.suffix.lower() in (".hdr", ".pic", ".rgbe"):
            return _channels(read_radiance_file(path, megapixels), f"{path}")
        kind = format_of(path)
        if kind == ".npy" or (kind == "TIFF" and _of_floats(path, megapixels)):
            numbers = read_numbers(path, (".npy", "TIFF"), megapixels)
            return (
                _channels(numbers, f"{path}")
                if numbers.dtype.kind == "f"
                else linear_picture(numbers)
            )
        return linear_picture(path, megapixels)
    if isinstance(picture, Tensor) and picture.is_floating_point():
        found = picture.detach().cpu().float().numpy()
        return _channels(np.moveaxis(found, 0, -1) if found.ndim == 3 else found, "picture")
    if isinstance(picture, np.ndarray) and picture.dtype.kind == "f":
        return _channels(picture, "picture")
    return linear_picture(picture, megapixels)


def _of_floats(path: Path, megapixels: float) -> bool:
    with tiff_page(path, megapixels) as page:
        return page.dtype is not None and np.dtype(page.dtype).kind == "f"


def _channels(numbers: np.ndarray, name: str) -> Tensor:
    """Return (3, H, W) float32 of (H, W), (H, W, 1) or (H, W, 3)."""
    values = numbers[..., None] if numbers.ndim == 2 else numbers
    if values.ndim != 3 or values.shape[-1] not in (1, 3) or 0 in values.shape:
        raise InputError(f"{name}: of shape {tuple(numbers.shape)}; allowed: grey or three colours")
    first = torch.from_numpy(np.ascontiguousarray(np.moveaxis(values, -1, 0), np.float32))
    return first.expand(3, -1, -1).contiguous()


def read_radiance_file(path: str | Path, megapixels: float = MEGAPIXELS) -> np.ndarray:
    """Read a file of Radiance: three colours that share an exponent (Ward, 1991).

    Values are those of the file, before its EXPOSURE is undone: 1 is white.

    Args:
        path: its size line must be `-Y height +X width`, as upright pictures have.
        megapixels: the largest that is read, millions of pixels.

    Returns:
        (height, width, 3) float32.

    Raises:
        InputError: the file is missing or broken, holds XYZ, or is not upright.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    head, blank, body = data[:_MOST_HEADER].partition(b"\n\n")
    if not data.startswith(_SIGNATURES) or not blank:
        raise InputError(f"{path}: is no file of Radiance; it begins with #?RADIANCE")
    if b"FORMAT=32-bit_rle_xyze" in head:
        raise InputError(f"{path}: holds XYZ; allowed: FORMAT=32-bit_rle_rgbe")
    line, _, _ = body.partition(b"\n")
    words = line.split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X":
        raise InputError(
            f"{path}: its size is {line[:40].decode('latin-1')!r}; allowed: -Y height +X width"
        )
    with decoding(path, "Radiance"):
        height, width = int(words[1]), int(words[3])
        check_size(path, height, width, megapixels)
        begin = len(head) + len(blank) + len(line) + 1
        rgbe = _rows(np.frombuffer(data, np.uint8)[begin:], height, width)
    scale = np.ldexp(np.float32(1.0), rgbe[..., 3].astype(np.int32) - 136)
    scale = np.where(rgbe[..., 3] == 0, np.float32(0.0), scale)
    return (rgbe[..., :3] + np.float32(0.5)) * scale[..., None]


def _rows(data: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the bytes (height, width, 4) of pixels, packed by runs or not."""
    if not (8 <= width < 1 << 15 and data[:4].tolist() == [2, 2, width >> 8, width & 255]):
        return data[: height * width * 4].reshape(height, width, 4)
    found = np.empty((height, 4, width), np.uint8)
    at = 0
    for row in found:
        if data[at : at + 4].tolist() != [2, 2, width >> 8, width & 255]:
            raise ValueError("a row does not begin with its width")
        at += 4
        for channel in row:
            filled = 0
            while filled < width:
                count = int(data[at])
                if count > 128:
                    count -= 128
                    values = data[at + 1 : at + 2]
                    at += 2
                else:
                    values = data[at + 1 : at + 1 + count]
                    at += 1 + count
                if count == 0 or filled + count > width:
                    raise ValueError("a run is longer than its row")
                channel[filled : filled + count] = values
                filled += count
    return np.moveaxis(found, 1, -1)
