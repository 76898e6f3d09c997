"""Rays from the sensor towards the exit pupil."""

import torch
from torch import Tensor

from dolens.optics.rays import Components


def rays_to_exit_pupil(
    x: Tensor,
    y: Tensor,
    sensor_z: Tensor,
    pupil_x: Tensor,
    pupil_y: Tensor,
    pupil_z: float | Tensor,
) -> Components:
    """Rays from points of the sensor towards points of the pupil plane, travelling towards -z.

    A pupil behind the sensor is virtual: the rays then travel away from its points.
    """
    dx, dy, dz = pupil_x - x, pupil_y - y, pupil_z - sensor_z
    inverse = torch.rsqrt(dx * dx + dy * dy + dz * dz)
    inverse = torch.where(dz > 0.0, -inverse, inverse)
    z = sensor_z.expand(inverse.shape)
    return Components(
        x.expand(inverse.shape),
        y.expand(inverse.shape),
        z,
        dx * inverse,
        dy * inverse,
        dz * inverse,
    )
