"""Rays, and what became of them."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.kernels.table import FARTHEST, LONGEST


class Status(IntEnum):
    """The end of a ray.

    A miss or a total reflection ends a ray.  A vignetted ray is traced on as if unclipped, and is
    VIGNETTED when nothing ends it later.
    """

    OK = 0
    VIGNETTED = 1
    TIR = 2
    MISSED = 3


def arrives(status: Tensor) -> Tensor:
    """Return which rays reach the sensor where nothing clips them, (...): OK and VIGNETTED."""
    return (status == Status.OK) | (status == Status.VIGNETTED)


# mm; distances along rays are held there, since infinity times zero is NaN.  A ray that meets a
# surface comes nowhere near it, and sums of several stay in single precision.
OUT_OF_REACH = 1e35


class Components(NamedTuple):
    """Rays as six tensors of one broadcast shape: position in mm and direction cosines.

    Separate components trace several times faster than an array of triples, because every
    operation then runs over contiguous memory.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    l: Tensor  # noqa: E741 - the field's own names for direction cosines are l, m, n
    m: Tensor
    n: Tensor


@dataclass(frozen=True)
class Rays:
    """A bundle of rays.

    Args:
        position: (..., 3), mm, in the lens's axes (first vertex at z = 0, light towards +z).
        direction: (..., 3), unit vectors; they are used as given, not normalised.
        wavelength: nm, a number or a tensor that broadcasts with the leading shape.

    A ray with a number that is not finite, a position beyond ±1e30 mm, or a direction cosine beyond
    ±2 misses the lens.
    """

    position: Tensor
    direction: Tensor
    wavelength: float | Tensor = 587.5618

    def components(self) -> Components:
        """The rays as six tensors of the common leading shape."""
        # Not torch.broadcast_shapes, whose first call imports SymPy: half a second.
        given = [self.position, self.direction]
        if isinstance(self.wavelength, Tensor):
            given.append(self.wavelength[..., None])
        position, direction, *_ = torch.broadcast_tensors(*given)
        return Components(*position.unbind(-1), *direction.unbind(-1))

    @staticmethod
    def from_components(ray: Components, wavelength: float | Tensor) -> "Rays":
        """Join six tensors to a bundle; the inverse of `components`."""
        position = torch.stack((ray.x, ray.y, ray.z), -1)
        direction = torch.stack((ray.l, ray.m, ray.n), -1)
        return Rays(position, direction, wavelength)


def finite_rays(rays: Rays, dtype: torch.dtype) -> Rays:
    """Return rays of which those that cannot be light stand still at 0: with NaN, a position beyond
    ±1e30 mm, or a direction cosine beyond ±2, in the precision `dtype`.

    Without a direction they miss every surface.  NaN itself would pass through a mask into the
    gradients of all rays together, since 0·NaN is NaN, and what overflows ends as NaN.
    """
    position, direction = (v.detach().to(dtype) for v in (rays.position, rays.direction))
    known = (position.abs() <= FARTHEST).all(-1) & (direction.abs() <= LONGEST).all(-1)
    return replace(
        rays,
        position=rays.position.where(known[..., None], 0.0),
        direction=rays.direction.where(known[..., None], 0.0),
    )


def distance_along(separation: Tensor, cosine: Tensor) -> Tensor:
    """Return the distances (mm) along rays that part planes: separation/cosine.

    It is ± 1e35 mm, a constant, where the quotient or its derivative would be out of single
    precision's range.  The cosine is not zero.
    """
    distance = separation.detach() / cosine.detach()
    lost = ~((distance / cosine.detach()).abs() <= OUT_OF_REACH)
    held = torch.full_like(distance, OUT_OF_REACH).copysign(distance)
    return torch.where(lost, held, separation.masked_fill(lost, 0.0) / cosine)


@dataclass(frozen=True)
class TracedRays:
    """Rays after a trace, with the leading shape of the rays that went in.

    Attributes:
        position: (..., 3), mm: on the sensor plane (forward) or on surface 1 (backward).
        direction: (..., 3), unit vectors in the last medium.
        valid: (...), bool: met every surface on its sag branch, strictly inside each aperture,
            without total reflection.
        status: (...), int8, a `Status`.
        surface: (...), int16: number of the surface where that happened, 0 where the ray is valid.
        path_length: (...), mm: Σ n·t along the ray, from its origin.
        transmission: (...), the share of unpolarised light that arrives, or None where the trace
            was not asked for it: the product of (T_s + T_p)/2 of every surface, or (R_s + R_p)/2 of
            a mirror, and of the glasses' internal transmittances from the ray's origin.
        points: (surfaces, ..., 3), mm, or None: the intersections in the order of the surfaces
            that the ray met, when the trace was asked to record them.

    Numbers of invalid rays are finite and carry no gradient.  A vignetted ray is traced on as if
    unclipped; those of a missed or totally reflected one mean nothing.
    """

    position: Tensor
    direction: Tensor
    valid: Tensor
    status: Tensor
    surface: Tensor
    path_length: Tensor
    points: Tensor | None = None
    transmission: Tensor | None = None

    def components(self) -> Components:
        """Position and direction as six tensors of the leading shape."""
        return Components(*self.position.unbind(-1), *self.direction.unbind(-1))
