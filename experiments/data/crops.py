"""Crops are cut from photographs and converted to linear light.

A random crop is a pure function of a seed and a counter, so any sample of a run can be made
again without the state of a generator: a resumed run equals an uninterrupted one to the bit.
"""

import logging
import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from dolens.errors import InputError
from dolens.experiments.data.photographs import Photograph
from dolens.sensor.colour import srgb_to_linear

_log = logging.getLogger(__name__)
_LINEAR_OF_BYTE = srgb_to_linear(torch.arange(256, dtype=torch.float64) / 255).float()
_CROP_STREAM = 0
_ORDER_STREAM = 1
_warned_of: set[str] = set()


def linear_light(encoded: Tensor) -> Tensor:
    """Decode sRGB bytes, any shape, to linear light in [0, 1], float32."""
    return _LINEAR_OF_BYTE.index_select(0, encoded.reshape(-1).int()).view(encoded.shape)


def random_crop(
    photo: Photograph,
    size: tuple[int, int],
    seed: int,
    index: int,
    scale_range: tuple[float, float] = (1.0, 1.0),
    *,
    flip_horizontal: bool = True,
    flip_vertical: bool = False,
) -> Tensor:
    """Cut the crop that belongs to sample number `index` of the run seeded with `seed`.

    Scale, position and flips depend on (seed, index) alone.  The scale is the number of
    photograph pixels along the side of one texel, log-uniform in `scale_range`; the cut region
    is converted to linear light and only then resized (bicubic, antialiased, clamped to
    [0, 1]).  A photograph too small for the largest scale narrows the range from above; one
    too small even for the smallest scale (at scale 1: smaller than the crop) is enlarged until
    the crop fits into it, with one warning that names it.

    Args:
        photo: the photograph to cut from.
        size: (height, width) of the crop in texels.
        seed: of the run, not negative.
        index: the global number of the sample, not negative.
        scale_range: (smallest, largest) scale, photograph pixels per texel.
        flip_horizontal: mirror left and right with probability 1/2.
        flip_vertical: mirror top and bottom with probability 1/2.

    Returns:
        (3, height, width) float32, linear light in [0, 1]; of a photograph with depth
        (4, height, width), mm last, that of the nearest pixel.

    Raises:
        InputError: a size below 1, a seed or index below 0, a scale range out of order.
    """
    check_size(size)
    check_scale_range(scale_range)
    draws = _uniform(seed, _CROP_STREAM, index, 5)
    scale = _scale(photo, size, scale_range, draws[0])
    height, width = _region(photo, size, scale)
    top = min(int(draws[1] * (photo.height - height + 1)), photo.height - height)
    left = min(int(draws[2] * (photo.width - width + 1)), photo.width - width)
    crop = _cut(photo, (top, left), (height, width), size)
    flips = [
        axis
        for axis, wanted, draw in ((2, flip_horizontal, draws[3]), (1, flip_vertical, draws[4]))
        if wanted and draw < 0.5
    ]
    return crop.flip(flips) if flips else crop


def random_order(count: int, seed: int, number: int) -> np.ndarray:
    """Return permutation number `number` of 0 … count-1 for a run, a function of the arguments.

    Raises:
        InputError: a seed or number below 0.
    """
    return np.argsort(_uniform(seed, _ORDER_STREAM, number, count), kind="stable")


def centred_crops(
    photo: Photograph, size: tuple[int, int], count: int, scale: float = 1.0
) -> Tensor:
    """Cut `count` crops evenly spaced over a photograph, without randomness.

    One crop is cut from the centre.  More lie on a grid and share no pixel of the photograph, so
    that no part of it counts twice.  A photograph too small for one crop is treated as in
    `random_crop`.

    Args:
        photo: the photograph to cut from.
        size: (height, width) of a crop in texels.
        count: how many.
        scale: photograph pixels along the side of one texel.

    Returns:
        (count, 3, height, width) float32, linear light in [0, 1].

    Raises:
        InputError: a size or count below 1, a scale that is not positive, or a photograph that
            cannot hold so many crops without overlap (see `crops_that_fit`).
    """
    if count < 1:
        raise InputError(f"crops of one photograph: {count}; allowed: 1 or more")
    return torch.stack([centred_crop(photo, size, count, number, scale) for number in range(count)])


def centred_crop(
    photo: Photograph, size: tuple[int, int], count: int, number: int, scale: float = 1.0
) -> Tensor:
    """Return crop `number` (from 0) of the `count` that `centred_crops` cuts: (3, height,
    width).
    """
    check_size(size)
    check_scale_range((scale, scale))
    if not 0 <= number < count:
        raise InputError(f"crop {number} of {count}; allowed: 0 to one less than their count")
    region = _region(photo, size, _scale(photo, size, (scale, scale), 0.0))
    most = _most_crops(photo, region)
    if count > most:
        raise InputError(
            f"{photo.name}: {count} crops of {region[0]}×{region[1]} of its "
            f"{photo.height}×{photo.width} pixels would overlap; allowed: at most {most}"
        )
    rows, columns = _grid(photo, region, count)
    cell = (2 * number + 1) * rows * columns // (2 * count)
    top = _cell_start(cell // columns, rows, photo.height, region[0])
    left = _cell_start(cell % columns, columns, photo.width, region[1])
    return _cut(photo, (top, left), region, size)


def crops_that_fit(photo: Photograph, size: tuple[int, int], scale: float = 1.0) -> int:
    """Count the crops that a photograph holds side by side, without overlap; at least 1.

    Args:
        photo: the photograph to cut from.
        size: (height, width) of a crop in texels.
        scale: photograph pixels along the side of one texel.

    Raises:
        InputError: a size below 1, a scale that is not positive.
    """
    check_size(size)
    check_scale_range((scale, scale))
    return _most_crops(photo, _region(photo, size, _scale(photo, size, (scale, scale), 0.0)))


def check_size(size: tuple[int, int]) -> None:
    """Raise `InputError` unless `size` is two counts of texels of at least 1."""
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"crop size: {size}; allowed: (height, width) in texels, 1 or more")


def check_scale_range(scale_range: tuple[float, float]) -> None:
    """Raise `InputError` unless 0 < smallest <= largest scale, both finite."""
    if len(scale_range) != 2 or not 0 < scale_range[0] <= scale_range[1] < math.inf:
        raise InputError(
            f"crop scale: {scale_range}; allowed: (smallest, largest) photograph pixels "
            "per texel, 0 < smallest <= largest"
        )


def _uniform(seed: int, stream: int, counter: int, count: int) -> np.ndarray:
    """Return `count` numbers in [0, 1), a function of the arguments."""
    if seed < 0 or counter < 0:
        raise InputError(f"seed {seed}, sample {counter}; allowed: integers of 0 or more")
    sequence = np.random.SeedSequence(seed, spawn_key=(stream, counter))
    return np.random.Generator(np.random.PCG64(sequence)).random(count)


def _scale(
    photo: Photograph,
    size: tuple[int, int],
    scale_range: tuple[float, float],
    draw: float,
) -> float:
    """Return the scale at `draw` in [0, 1) of the range, as far as the photograph allows it."""
    smallest, largest = scale_range
    limit = min(photo.height / size[0], photo.width / size[1])
    if limit < smallest:
        if photo.name not in _warned_of:
            _warned_of.add(photo.name)
            _log.warning(
                "%s: %d×%d pixels, too small for crops of %d×%d texels at %g pixels per texel; "
                "enlarged to fit, at %.3g pixels per texel",
                photo.name,
                photo.height,
                photo.width,
                *size,
                smallest,
                limit,
            )
        return limit
    return smallest * (min(largest, limit) / smallest) ** draw


def _region(photo: Photograph, size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return (height, width) in photograph pixels that a crop of `size` texels covers."""
    height = min(max(round(size[0] * scale), 1), photo.height)
    width = min(max(round(size[1] * scale), 1), photo.width)
    return height, width


def _cut(
    photo: Photograph,
    corner: tuple[int, int],
    region: tuple[int, int],
    size: tuple[int, int],
) -> Tensor:
    (top, left), (height, width) = corner, region
    crop = linear_light(photo.encoded[:, top : top + height, left : left + width])
    depth = None if photo.depth is None else photo.depth[top : top + height, left : left + width]
    if region != tuple(size):
        resized = interpolate(
            crop[None], size=tuple(size), mode="bicubic", align_corners=False, antialias=True
        )
        crop = resized[0].clamp_(0.0, 1.0)
        if depth is not None:
            # Between two depths there is no surface.
            depth = interpolate(depth[None, None], size=tuple(size), mode="nearest-exact")[0, 0]
    return crop if depth is None else torch.cat((crop, depth[None]))


def _most_crops(photo: Photograph, region: tuple[int, int]) -> int:
    """Return how many regions (height, width) in pixels lie side by side on a photograph."""
    return (photo.height // region[0]) * (photo.width // region[1])


def _grid(photo: Photograph, region: tuple[int, int], count: int) -> tuple[int, int]:
    """Return (rows, columns) with at least `count` cells that a region fits into: fewest cells."""

    def cost(grid: tuple[int, int]) -> tuple[int, float]:
        rows, columns = grid
        cell_shape = (photo.height * region[1] * columns) / (photo.width * region[0] * rows)
        return rows * columns, abs(math.log(cell_shape))

    grids = ((rows, math.ceil(count / rows)) for rows in range(1, photo.height // region[0] + 1))
    return min((grid for grid in grids if grid[1] <= photo.width // region[1]), key=cost)


def _cell_start(cell: int, cells: int, extent: int, length: int) -> int:
    """Return the start of the crop of a cell, centred in it."""
    return ((2 * cell + 1) * extent - cells * length) // (2 * cells)
