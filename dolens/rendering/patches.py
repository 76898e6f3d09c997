"""Overlapping patches of an image, a node in the middle of each, and their weights."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError


class Patch(NamedTuple):
    """A rectangle of the image around a node.

    Attributes:
        top, bottom, left, right: rows and columns of the image, half open.
        weight: (bottom - top, right - left), or one for each channel in front of these: how much of
            each pixel the node's kernel makes.
    """

    top: int
    bottom: int
    left: int
    right: int
    weight: Tensor


class Coordinates(NamedTuple):
    """Fractional rows and columns of the texture that each pixel of the image looks at.

    Attributes:
        rows: (D, C, height, width).
        columns: (D, C, height, width).
    """

    rows: Tensor
    columns: Tensor


@dataclass(frozen=True)
class PatchLayout:
    """The patches of an image, and where its pixels look in the texture.

    Attributes:
        patches: N of them.
        image_size: height and width.
        origin: row and column of the texture that pixel (0, 0) looks at, where there are no
            `coordinates`.
        coordinates: where the pixels look, if that is not simply every pixel a texel further.
        fused: whether the CPU's kernels look up and splat, else PyTorch's operations.
    """

    patches: Sequence[Patch]
    image_size: tuple[int, int]
    origin: tuple[int, int] = (0, 0)
    coordinates: Coordinates | None = None
    fused: bool = False


def node_positions(length: int, count: int) -> list[float]:
    """Coordinates of `count` nodes along `length` pixels: the ends included, or the middle."""
    if count == 1:
        return [0.5 * (length - 1)]
    return [i * (length - 1) / (count - 1) for i in range(count)]


def patches(height: int, width: int, rows: int, columns: int, like: Tensor) -> list[Patch]:
    """The patches of a grid of nodes, row after row; at each pixel their weights sum to one.

    Weights are bilinear between the nodes.

    Raises:
        InputError: more nodes than pixels.
    """
    if rows < 1 or columns < 1 or rows > height or columns > width:
        raise InputError(
            f"renderer: fields must be from 1 to {height} rows and 1 to {width} columns, "
            f"not {rows}, {columns}"
        )
    vertical, horizontal = (
        [_hat(length, count, i, like) for i in range(count)]
        for length, count in ((height, rows), (width, columns))
    )
    return [
        Patch(top, bottom, left, right, down[:, None] * across)
        for top, bottom, down in vertical
        for left, right, across in horizontal
    ]


def _hat(length: int, count: int, node: int, like: Tensor) -> tuple[int, int, Tensor]:
    """First pixel, end and weights of a node along one side."""
    place = torch.arange(length, dtype=torch.float64)
    if count == 1:
        return 0, length, torch.ones_like(place).to(like)
    spacing = (length - 1) / (count - 1)
    weight = (1.0 - (place - node * spacing).abs() / spacing).clamp(min=0.0)
    if count == 2:
        # All patches are then the whole, and share what is done to the texture.
        return 0, length, weight.to(like)
    inside = torch.nonzero(weight > 0.0).flatten()
    first, end = int(inside[0]), int(inside[-1]) + 1
    return first, end, weight[first:end].to(like)
