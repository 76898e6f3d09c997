"""Rays of a field are launched from the plane that faces it.

This plane runs through the first vertex, perpendicular to the line from the object point to that
vertex.  It faces a wide field as squarely as a narrow one, however far the entrance pupil wanders,
and for an object at infinity it is a wavefront.
"""

import torch
from torch import Tensor

from dolens.optics.paraxial import vergence
from dolens.optics.rays import Components


def field_line(
    field: Tensor, object_distance: float | Tensor | None = None
) -> tuple[Tensor, float | Tensor]:
    """Return the direction of the line from the object point to the first vertex.

    At infinity it is (tan x, tan y, 1) normalised, written without a tangent: (sin x·cos y,
    cos x·sin y, cos x·cos y) goes on through 90° to light that comes from behind the first vertex.

    Args:
        field: (..., 2), angles in radians for an object at infinity; else the object point's x and
            y in mm.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.

    Returns:
        The unit vectors (..., 3), and 1/object_distance (1/mm).
    """
    near = vergence(object_distance)
    if not isinstance(near, Tensor):
        return (_line_of_angles(field) if near == 0.0 else line_of_slopes(-field * near)), near
    near = near.to(field)
    far = near[..., None] == 0.0
    # Of a finite object the angles, of an infinite one the slopes, are never used.
    angles, slopes = torch.where(far, field, 0.0), torch.where(far, 0.0, -field * near[..., None])
    return torch.where(far, _line_of_angles(angles), line_of_slopes(slopes)), near


def _line_of_angles(angles: Tensor) -> Tensor:
    """Return unit vectors (..., 3) of field angles (..., 2), rad."""
    (sx, sy), (cx, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    line = torch.stack((sx * cy, cx * sy, cx * cy), -1)
    return line / line.norm(dim=-1, keepdim=True)


def line_of_slopes(slopes: Tensor) -> Tensor:
    """Return unit vectors (..., 3) along (slope x, slope y, 1), of slopes (..., 2)."""
    line = torch.cat((slopes, torch.ones_like(slopes[..., :1])), -1)
    return line / line.norm(dim=-1, keepdim=True)


def launch(line: Tensor, near: float | Tensor, q: Tensor) -> Components:
    """Rays of a field through points of the plane that faces it.

    Args:
        line: (..., 3), unit vector of the line from the object point to the first vertex.
        near: 1/object distance, 1/mm; 0 for an object at infinity.
        q: (..., 2), mm, in the plane through the first vertex perpendicular to that line; its axes
            are the lens's x and y, turned with z the shortest way into the line.
    """
    (l, m, n), (qx, qy) = line.unbind(-1), q.unbind(-1)  # noqa: E741
    along = (l * qx + m * qy) / (1.0 + n)
    x, y, z = qx - l * along, qy - m * along, -(l * qx + m * qy)
    # The object point lies a distance n·near before the plane, so far ones lose no digits.
    w = n * near
    inverse = torch.rsqrt(1.0 + w * w * (qx * qx + qy * qy))
    direction = ((l + w * x) * inverse, (m + w * y) * inverse, (n + w * z) * inverse)
    return Components(*torch.broadcast_tensors(x, y, z, *direction))


def polar_angles(line: Tensor) -> tuple[Tensor, Tensor]:
    """Return angles (...) of lines to the axis, rad, and unit vectors (..., 2) of their azimuths;
    zero along the axis.
    """
    across, along = line[..., :2], line[..., 2]
    sine = across.norm(dim=-1)
    return torch.atan2(sine, along), across / sine.clamp(min=torch.finfo(line.dtype).tiny)[
        ..., None
    ]
