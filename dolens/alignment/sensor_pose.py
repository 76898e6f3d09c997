"""A sensor that is displaced and tilted meets light elsewhere than the plane it was meant for."""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.optics.elements import rotation_matrix

# Where the sensor is besides its distance: mm across, and radians about the point on the axis.
SENSOR_POSE = ("sensor.x", "sensor.y", "sensor.tilt_x", "sensor.tilt_y")


class OnSensor(NamedTuple):
    """Points of light on a posed sensor, with their derivatives.

    Attributes:
        points: (..., 2), mm, along the sensor's own axes from its centre.
        by_point: (..., 2, 2), with respect to where the rays cross the plane z = 0.
        by_tangent: (..., 2, 2), mm, with respect to the rays' tangents.
        by_pose: (..., 2, 5), with respect to the pose of `SENSOR_POSE` and the plane.
    """

    points: Tensor
    by_point: Tensor
    by_tangent: Tensor
    by_pose: Tensor


def on_sensor(crossing: Tensor, tangent: Tensor, pose: Tensor, plane: float) -> OnSensor:
    """Return where rays meet a sensor, in its own axes.

    With O the sensor's centre, e₁ and e₂ its axes, n its normal, P where a ray crosses the plane
    z = 0 and t = (l/n, m/n, 1), the ray meets it at p = P + s·t, s = n·(O - P)/(n·t), seen at
    e·(p - O).  A displacement dP moves that by e·(dP - t (n·dP)/(n·t)), a turn ω of the sensor
    by (ω×e)·(p - O) + e·t (ω×n)·(O - p)/(n·t), and dt by s times what dP does.

    Args:
        crossing: (..., 2), mm, of the rays with the plane of the sensor as planned.
        tangent: (..., 2), their l/n and m/n.
        pose: (4,), in the order of `SENSOR_POSE`, mm and radians.
        plane: by how much the sensor stands farther from the lens, mm.
    """
    zero = torch.zeros_like(pose[0])
    rotation = rotation_matrix(pose[2], pose[3], zero)
    axes, normal = rotation[:, :2].mT, rotation[:, 2]
    centre = torch.stack([pose[0], pose[1], zero + plane])
    start = torch.cat([crossing, torch.zeros_like(crossing[..., :1])], -1)
    t = torch.cat([tangent, torch.ones_like(tangent[..., :1])], -1)
    cosine = t @ normal
    s = ((centre - start) @ normal) / cosine
    apart = start + s[..., None] * t - centre
    along = t @ axes.mT
    # e_i·(1 - t nᵀ/(n·t)), (..., 2, 3).
    full = axes - along[..., :, None] * (normal / cosine[..., None])[..., None, :]
    # dR/dα = ω×R: x is turned last, so its ω is the lens's x axis; y's is Rx·(0, 1, 0).
    about_x = torch.stack([zero + 1.0, zero, zero])
    about_y = torch.stack([zero, torch.cos(pose[2]), torch.sin(pose[2])])
    turned = []
    for omega in (about_x, about_y):
        moved_axes = torch.linalg.cross(omega.expand_as(axes), axes)
        moved_normal = torch.linalg.cross(omega, normal)
        slip = -(apart @ moved_normal) / cosine
        turned.append(apart @ moved_axes.mT + along * slip[..., None])
    by_pose = torch.cat(
        [-full[..., :2], torch.stack(turned, -1), -full[..., 2:]],
        -1,
    )
    by_point = full[..., :2]
    return OnSensor(apart @ axes.mT, by_point, s[..., None, None] * by_point, by_pose)
