"""First-order optics: focal length, focus, pupils.  Everything is differentiable."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.optics.system import OpticalSystem


class Pupil(NamedTuple):
    """A paraxial image of the stop: z from the first vertex and diameter, mm."""

    z: Tensor
    diameter: Tensor


@dataclass(frozen=True)
class FirstOrder:
    """First-order properties at one wavelength, mm.

    Attributes:
        efl: effective focal length, -1/power of the reduced matrix (n·u), positive if converging.
        bfd: from the last vertex to the rear focus.
        focus: z of the rear focus, from the first vertex.
        entrance_pupil: the stop seen from the object.
        exit_pupil: the stop seen from the sensor.
        f_number: efl / entrance pupil diameter.
        image_index: index of the medium at the sensor.
    """

    efl: Tensor
    bfd: Tensor
    focus: Tensor
    entrance_pupil: Pupil
    exit_pupil: Pupil
    f_number: Tensor
    image_index: Tensor


def surface_matrix(
    system: OpticalSystem, wavelength: float | Tensor, first: int, last: int
) -> Tensor:
    """Paraxial matrix acting on (y, n·u) from just before surface `first` to just after `last`.

    Surfaces count from 1; both planes are the vertices; `first` > `last` is the identity.
    Refraction is [[1, 0], [-(n' - n)c, 1]], transfer [[1, t/n], [0, 1]] (Welford, ch. 3).
    """
    indices = system.indices(wavelength)
    matrix = torch.eye(2, dtype=system.dtype, device=system.device)
    for number in range(first, last + 1):
        if number > first:
            gap = system.thicknesses[number - 2] / indices[number - 1]
            matrix = _matrix(1.0, gap, 0.0, 1.0, matrix) @ matrix
        surface = system.surfaces[number - 1]
        curvature = surface.shape.paraxial_curvature(surface.parameters)
        power = (indices[number] - indices[number - 1]) * curvature
        matrix = _matrix(1.0, 0.0, -power, 1.0, matrix) @ matrix
    return matrix


def entrance_pupil(system: OpticalSystem, wavelength: float | Tensor) -> Pupil:
    """Image of the stop through the surfaces before it."""
    indices = system.indices(wavelength)
    stop = system.stop
    # The stop's own refraction belongs to the light behind it.
    matrix = surface_matrix(system, wavelength, 1, stop - 1)
    if stop > 1:
        gap = system.thicknesses[stop - 2] / indices[stop - 1]
        matrix = _matrix(1.0, gap, 0.0, 1.0, matrix) @ matrix
    # A ray with y = 0 on the stop crosses the axis where the object space sees the stop.
    a, b = matrix[0, 0], matrix[0, 1]
    z = b / a * indices[0]
    return Pupil(z, 2.0 * system.surfaces[stop - 1].semi_diameter / a.abs())


def exit_pupil(system: OpticalSystem, wavelength: float | Tensor) -> Pupil:
    """Image of the stop through the surfaces from the stop on."""
    stop, count = system.stop, len(system.surfaces)
    matrix = surface_matrix(system, wavelength, stop, count)
    b, d = matrix[0, 1], matrix[1, 1]
    n = system.indices(wavelength)[-1]
    # From the axis at the stop: height b and slope d/n at the last vertex, per unit of n·u.
    z = system.vertices[count - 1] - b / d * n
    return Pupil(z, 2.0 * system.surfaces[stop - 1].semi_diameter / d.abs())


def first_order(system: OpticalSystem, wavelength: float | Tensor) -> FirstOrder:
    """First-order properties of a centred lens.

    Args:
        system: the lens.
        wavelength: nm.
    """
    count = len(system.surfaces)
    matrix = surface_matrix(system, wavelength, 1, count)
    n = system.indices(wavelength)[-1]
    efl = -1.0 / matrix[1, 0]
    bfd = -n * matrix[0, 0] / matrix[1, 0]
    pupil = entrance_pupil(system, wavelength)
    return FirstOrder(
        efl=efl,
        bfd=bfd,
        focus=system.vertices[count - 1] + bfd,
        entrance_pupil=pupil,
        exit_pupil=exit_pupil(system, wavelength),
        f_number=efl / pupil.diameter,
        image_index=torch.as_tensor(n, dtype=system.dtype, device=system.device),
    )


def image_distance(system: OpticalSystem, wavelength: float | Tensor, depth: float) -> Tensor:
    """z (mm from the first vertex) of the paraxial image of an object at -depth mm."""
    matrix, n = _object_to_last_vertex(system, wavelength, depth)
    z_last = system.vertices[len(system.surfaces) - 1]
    return z_last - n * matrix[0, 1] / matrix[1, 1]


def chief_ray_magnification(
    system: OpticalSystem, wavelength: float | Tensor, depth: float
) -> Tensor:
    """Height on the sensor over height on the object, along the paraxial chief ray.

    The chief ray passes the centre of the stop, so the ratio stays meaningful where the sensor
    is out of focus: it is where the blur is centred.  Negative for an inverted image.

    Args:
        system: the lens.
        wavelength: nm.
        depth: distance of the object in front of the first vertex, mm.
    """
    pupil = entrance_pupil(system, wavelength)
    indices = system.indices(wavelength)
    # Object height 1: the chief ray heads from (z = -depth, y = 1) to the entrance pupil's centre.
    slope = -1.0 / (pupil.z + depth)
    height = 1.0 + slope * depth
    matrix = surface_matrix(system, wavelength, 1, len(system.surfaces))
    y = matrix[0, 0] * height + matrix[0, 1] * (indices[0] * slope)
    u = (matrix[1, 0] * height + matrix[1, 1] * (indices[0] * slope)) / indices[-1]
    return y + u * system.sensor_distance


def _object_to_last_vertex(
    system: OpticalSystem, wavelength: float | Tensor, depth: float
) -> tuple[Tensor, float | Tensor]:
    indices = system.indices(wavelength)
    matrix = surface_matrix(system, wavelength, 1, len(system.surfaces))
    return matrix @ _matrix(1.0, depth / indices[0], 0.0, 1.0, matrix), indices[-1]


def _matrix(
    a: float | Tensor, b: float | Tensor, c: float | Tensor, d: float | Tensor, like: Tensor
) -> Tensor:
    """A 2×2 matrix of numbers and scalar tensors."""
    entries = [torch.as_tensor(e, dtype=like.dtype, device=like.device) for e in (a, b, c, d)]
    return torch.stack(entries).reshape(2, 2)
