"""Depth maps are read from files beside their photographs."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from dolens.errors import InputError
from dolens.sensor.image_files import MEGAPIXELS, read_numbers

ENDINGS = (".npy", ".png", ".tif", ".tiff")
"""Endings of depth maps, in the order in which they are looked for."""


def depth_map_of(photograph: Path, suffix: str) -> Path | None:
    """Return the depth map beside a photograph: `hall.jpg` has `hall_depth.png`, for `_depth`; or
    None.
    """
    for ending in ENDINGS:
        path = photograph.with_name(f"{photograph.stem}{suffix}{ending}")
        if path.is_file():
            return path
    return None


def is_depth_map(path: Path, suffix: str) -> bool:
    """Return whether a file's name is that of a depth map."""
    return path.stem.endswith(suffix) and path.suffix.lower() in ENDINGS


def read_depth_map(path: Path, unit: float, megapixels: float = MEGAPIXELS) -> Tensor:
    """Read a depth map in mm, (height, width), float32, with holes filled.

    Numbers that are zero, negative or not finite are holes, as depth cameras leave them in the
    shadows that near things cast on far ones: each takes the largest depth on its border.

    Args:
        path: a grey image of integers or floating-point numbers, or an array that numpy saved.
        unit: mm per unit of its numbers.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, has several channels, or no depth at all.
    """
    values = read_numbers(path, megapixels=megapixels)
    if values.ndim != 2:
        raise InputError(
            f"{path}: {values.dtype} of shape {values.shape}; allowed: a depth map of one channel, "
            "integers or floating-point numbers"
        )
    depth = torch.from_numpy(values.astype(np.float32)) * unit
    known = torch.isfinite(depth) & (depth > 0.0)
    if not bool(known.any()):
        raise InputError(f"{path}: no depth above 0; allowed: at least one")
    return _filled(torch.where(known, depth, 0.0))


def _filled(depth: Tensor) -> Tensor:
    """Replace zeros by the largest depth on the border of their hole."""
    hole = depth == 0.0
    while True:
        around = max_pool2d(depth[None], 3, stride=1, padding=1)[0]
        filled = torch.where(hole, around, depth)
        if torch.equal(filled, depth):
            return depth
        depth = filled
