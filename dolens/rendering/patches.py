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
    """Fractional rows and columns, in the texture, of the object point of each pixel.

    Attributes:
        rows: (D, C, height, width).
        columns: (D, C, height, width).
    """

    rows: Tensor
    columns: Tensor


@dataclass(frozen=True)
class PatchLayout:
    """The patches of an image, and the object points of its pixels in the texture.

    Attributes:
        patches: N of them.
        image_size: height and width.
        origin: row and column of the object point of pixel (0, 0), where there are no
            `coordinates`.
        coordinates: object points of the pixels, if they are not simply a texel apart.
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
    vertical, horizontal = _sides(height, rows, like), _sides(width, columns, like)
    return [
        Patch(top, bottom, left, right, down[:, None] * across)
        for top, bottom, down in vertical
        for left, right, across in horizontal
    ]


def triangle_weights(places: Tensor, length: int, count: int) -> Tensor:
    """Return the linear interpolation weights, (N, count), of the nodes of `node_positions`.

    Args:
        places: (N,), coordinates along the side, pixels.
        length: pixels of the side.
        count: nodes along it.
    """
    if count == 1:
        return torch.ones(len(places), 1, dtype=places.dtype)
    spacing = (length - 1) / (count - 1)
    node = torch.arange(count, dtype=places.dtype) * spacing
    return (1.0 - (places[:, None] - node).abs() / spacing).clamp(min=0.0)


def _sides(length: int, count: int, like: Tensor) -> list[tuple[int, int, Tensor]]:
    """Return the first pixel, the end and the weights of every node along one side."""
    weights = triangle_weights(torch.arange(length, dtype=torch.float64), length, count)
    sides = []
    for weight in weights.T.contiguous():
        inside = torch.nonzero(weight > 0.0).flatten()
        # Two patches are each the whole, and share the transform of the texture.
        first, end = (0, length) if count <= 2 else (int(inside[0]), int(inside[-1]) + 1)
        sides.append((first, end, weight[first:end].to(like)))
    return sides
