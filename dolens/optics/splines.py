"""Cubic splines through numbers at nodes."""

import numpy as np


def spline_slopes(values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the slopes at the nodes of the cubic spline through values, along their last axis.

    Second derivatives are continuous at every node, and third ones at the last but one from either
    end, so that cubics are reproduced.  Two or three nodes have the polynomial through them.
    Source: de Boor, A Practical Guide to Splines, ch. IV ("not-a-knot").

    Args:
        values: (..., n) with n ≥ 2, real or complex.
        nodes: (n,), rising.
    """
    count, gap = len(nodes), np.diff(nodes)
    step = np.diff(values, axis=-1) / gap
    if count == 2:
        return np.concatenate([step, step], -1)
    left, right = gap[:-1], gap[1:]
    # Of the parabola through three neighbours.
    middle = (right * step[..., :-1] + left * step[..., 1:]) / (left + right)
    first, last = 2.0 * step[..., :1] - middle[..., :1], 2.0 * step[..., -1:] - middle[..., -1:]
    if count == 3:
        return np.concatenate([first, middle, last], -1)
    system = np.diag(np.concatenate([[1.0], 2.0 * (left + right), [1.0]]))
    inner = np.arange(1, count - 1)
    system[inner, inner - 1], system[inner, inner + 1] = right, left
    # One cubic through the first three nodes, and one through the last three.
    for row, at, near, far in ((0, 1, gap[0], gap[1]), (-1, -2, gap[-1], gap[-2])):
        system[row, row], system[row, at] = far, near + far
    ends = [
        ((near + 2.0 * (near + far)) * far * own + near * near * beside) / (near + far)
        for near, far, own, beside in (
            (gap[0], gap[1], step[..., :1], step[..., 1:2]),
            (gap[-1], gap[-2], step[..., -1:], step[..., -2:-1]),
        )
    ]
    given = np.concatenate([ends[0], 3.0 * (left + right) * middle, ends[1]], -1)
    return np.linalg.solve(system, given.reshape(-1, count).T).T.reshape(values.shape)
