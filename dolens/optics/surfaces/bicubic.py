"""Bicubic interpolation of a regular grid from values and slopes at its nodes (Hermite's form)."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


def spline_slopes(values: np.ndarray, spacing: float) -> np.ndarray:
    """Return the slopes along the last axis of the cubic spline through equally spaced values.

    Second derivatives are continuous at every node, and third ones at the last but one from either
    end, so that cubics are reproduced.  Two or three nodes have the polynomial through them.
    Source: de Boor, A Practical Guide to Splines, ch. IV ("not-a-knot").

    Args:
        values: (..., n) with n ≥ 2.
        spacing: of the nodes.
    """
    count = values.shape[-1]
    step = np.diff(values, axis=-1) / spacing
    if count == 2:
        return np.concatenate([step, step], -1)
    middle = 0.5 * (step[..., :-1] + step[..., 1:])
    bend = step[..., 1:] - step[..., :-1]
    if count == 3:
        return np.concatenate([middle - bend, middle, middle + bend], -1)
    system = np.diag(np.full(count, 4.0)) + np.eye(count, k=1) + np.eye(count, k=-1)
    right = np.concatenate([-2.0 * bend[..., :1], 6.0 * middle, 2.0 * bend[..., -1:]], -1)
    system[0], system[-1] = 0.0, 0.0
    system[0, 0], system[0, 2], system[-1, -1], system[-1, -3] = 1.0, -1.0, 1.0, -1.0
    return np.linalg.solve(system, right.reshape(-1, count).T).T.reshape(values.shape)


class Cell(NamedTuple):
    """Basis functions of Hermite's cubics along one axis, and the cell of each point.

    Attributes:
        first: index of the cell's lower node, int64.
        value: weights of value and slope at the lower node, then at the upper one; four tensors.
        slope: their derivatives, 1/mm.
    """

    first: Tensor
    value: tuple[Tensor, ...]
    slope: tuple[Tensor, ...]


def cell_of(u: Tensor, spacing: Tensor, count: int) -> Cell:
    """Return the cell of points along one axis, and the basis there.

    Args:
        u: mm, from the middle of the grid.
        spacing: mm.
        count: nodes.
    """
    place = u / spacing + 0.5 * (count - 1)
    first = place.detach().floor().clamp(0, count - 2)
    first = torch.where(first == first, first, torch.zeros_like(first))
    # Beyond the grid the outermost cell goes on straight: along its tangent at the edge.
    t = place - first
    inside = torch.where(t < 0.0, torch.zeros_like(t), torch.where(t > 1.0, torch.ones_like(t), t))
    beyond = t - inside
    s = 1.0 - inside
    value = (
        s * s * (1.0 + 2.0 * inside),
        inside * s * s * spacing,
        inside * inside * (1.0 + 2.0 * s),
        -inside * inside * s * spacing,
    )
    bell = 6.0 * inside * s
    slope = (
        -bell / spacing,
        s * (s - 2.0 * inside),
        bell / spacing,
        inside * (inside - 2.0 * s),
    )
    past = beyond * spacing
    return Cell(
        first.long(),
        tuple(v + past * d for v, d in zip(value, slope, strict=True)),
        slope,
    )


def bicubic(
    nodes: Tensor, spacing: tuple[Tensor, Tensor], x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the interpolated value and its slopes along x and y.

    Args:
        nodes: (rows, columns, 4): value (mm), slopes along x and y, and ∂²/∂x∂y (1/mm); rows along
            y.
        spacing: of columns and of rows, mm.
        x: mm, from the middle of the grid.
        y: mm.
    """
    x, y = torch.broadcast_tensors(x, y)
    rows, columns = nodes.shape[0], nodes.shape[1]
    along, across = cell_of(x, spacing[0], columns), cell_of(y, spacing[1], rows)
    total, sx, sy = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    flat = nodes.reshape(-1, 4)
    for j in range(2):
        for i in range(2):
            index = (across.first + j) * columns + along.first + i
            node = flat.index_select(0, index.reshape(-1)).reshape(*index.shape, 4)
            for k in range(4):
                a, b = 2 * i + k % 2, 2 * j + k // 2
                c = node[..., k]
                total = total + c * along.value[a] * across.value[b]
                sx = sx + c * along.slope[a] * across.value[b]
                sy = sy + c * along.value[a] * across.slope[b]
    return total, sx, sy
