"""Pictures are read as linear light; what a camera makes of them is measured and written."""

import logging
import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.commands.apply_options import PictureOptions
from dolens.experiments.running.run_files import write_json
from dolens.plotting import save_figure
from dolens.plotting.pictures import applied_figure
from dolens.reconstruction import psnr_db, structural_similarity
from dolens.sensor.image_files import MEGAPIXELS, format_of, read_numbers
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


logger = logging.getLogger(__name__)

_SMALLEST = 16
# Copies of a picture that are held at once, float32 of three channels; and a warning from there on.
_COPIES, _MUCH_MEMORY = 12, 4e9


@dataclass(frozen=True)
class Applied:
    """What became of one picture at one depth.

    Attributes:
        name: of the picture, with its depth where there are several.
        files: that were written.
        metrics: PSNR and SSIM of the sensor's image (`raw_…`) and of the restored one; empty where
            there is no truth.
        mapping: how the picture came to lie on the sensor, in words.
    """

    name: str
    files: tuple[Path, ...]
    metrics: Mapping[str, float]
    mapping: str


def apply_to_files(
    files: Sequence[str | Path],
    into: Path,
    each: Callable[[Path, Path], list[Applied]],
    record: Callable[[], dict[str, Any]],
) -> list[Applied]:
    """Apply a camera to files, and write beside the images what became of each.

    Args:
        files: of the pictures.
        into: the folder that is written to; it is made.
        each: of a file and that folder: what a camera makes of it.
        record: what is true of all of them, for the record.

    Raises:
        InputError: the folder cannot be made, or a file not be used.
    """
    try:
        into.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--out: {into}: no folder can be made here ({reason})") from None
    found = []
    for file in files:
        applied = each(Path(file).expanduser(), into)
        found += applied
        images = {
            entry.name: {
                "mapping": entry.mapping,
                "files": [path.name for path in entry.files],
                # JSON has no infinity, as a depth may be.
                **{n: v if math.isfinite(v) else None for n, v in entry.metrics.items()},
            }
            for entry in applied
        }
        write_json(
            into / f"{Path(file).stem}.json", {"picture": str(file), "images": images, **record()}
        )
    return found


def check_files(files: Sequence[str | Path]) -> None:
    """Refuse files that are missing or no pictures, or that would write the same ones.

    Raises:
        InputError: the line names the file.
    """
    stems = [Path(file).stem for file in files]
    for file in files:
        format_of(Path(file).expanduser())
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{twice}: two pictures of this name would write the same files")


def picture_of(file: Path, options: PictureOptions) -> Picture:
    """Read a picture, and log what of its file is not taken as it stands.

    Raises:
        InputError: the file cannot be read, or is too large.
    """
    picture = read_picture(file, options.megapixels)
    for note in picture.notes:
        logger.warning("%s: %s", file, note)
    return picture


def check_size(file: Path, size: Sequence[int]) -> None:
    """Refuse a picture (height, width) that is too small, and warn of one that is very large."""
    height, width = size
    if min(height, width) < _SMALLEST:
        raise InputError(
            f"{file}: {width}×{height} pixels; allowed: {_SMALLEST} or more along each side"
        )
    memory = 4.0 * 3 * height * width * _COPIES
    if memory > _MUCH_MEMORY:
        logger.warning(
            "%s: %d×%d pixels take about %.0f GB of memory", file, width, height, memory / 1e9
        )


def names_at_depths(name: str, depths: Sequence[float]) -> dict[float, str]:
    """Return what a picture is called at each depth: by its own name where there is one."""
    if len(set(depths)) == 1:
        return dict.fromkeys(depths, name)
    return {depth: f"{name}_{label(depth)}" for depth in depths}


def label(depth: float) -> str:
    """Return a depth (mm) in metres, as names of files have it: `6m`, `infm` of infinity."""
    return f"{depth / 1000.0:g}m"


def written(
    images: Mapping[str, Tensor],
    signal: Tensor,
    depth: float,
    name: str,
    folder: Path,
    options: PictureOptions,
) -> tuple[tuple[Path, ...], dict[str, float]]:
    """Measure and write what a camera makes of a picture.

    Args:
        images: truth, sensor and restored, each (3, H, W), display-encoded, and the map of depths
            if there is one.
        signal: what the sensor gave, (1 or 3, H, W), or of N readouts (N, 1 or 3, H, W).
        depth: of the picture, mm.
        name: that files begin with.
        folder: that they are written to.
        options: bits and format.

    Returns:
        The files, and PSNR and SSIM.
    """
    truth, files, metrics = images["truth"], [], {"depth_mm": float(depth)}
    for kind, prefix in (("sensor", "raw_"), ("restored", "")):
        image = images[kind]
        metrics[f"{prefix}psnr_db"] = float(psnr_db(image[None], truth[None].to(image)))
        metrics[f"{prefix}ssim"] = float(structural_similarity(image[None], truth[None].to(image)))
        files.append(folder / f"{name}_{kind}.{options.format}")
        write_picture(files[-1], image, options.bits)
    if "depth" in images:
        files.append(folder / f"{name}_depth.png")
        write_picture(files[-1], images["depth"], 8)
    if options.save_raw:
        files.append(folder / f"{name}_raw.npy")
        np.save(files[-1], signal.movedim(-3, -1).squeeze(-1).float().cpu().numpy())
    where = f"{depth / 1000.0:g} m" if math.isfinite(depth) else "infinity"
    title = f"{name.removesuffix(f'_{label(depth)}')} at {where}"
    numbers = {"sensor": metrics["raw_psnr_db"], "restored": metrics["psnr_db"]}
    files.append(folder / f"{name}_comparison.png")
    save_figure(applied_figure(images, numbers, title), files[-1])
    return tuple(files), metrics
